//! Destroy and repair: the objects of a small neighbourhood are removed, others are born from their detections, and the better of
//! both, by J, stays.
//!
//! It is the one move that untangles objects which exchanged detections: halves of objects, objects between two others, and
//! objects behind each other. It also splits an object in two.

use nalgebra::Vector3;
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use super::assign::{Claim, Trajectories, assign_among, claims_of_all};
use super::few::most_probable;
use super::propose::{Hypothesis, propose_among};
use super::quick::quick_estimate;
use crate::progress::{Halt, Progress};
use crate::robust::energy::estimate::visits;
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::{
    LEAST_GAIN_OF_MOVE, NOBODY, ONE_SIDE_COSINE, Object, by_side, fit, implied_size, object, owners, size_of,
};
use crate::robust::model::{CHANCE_SIGMAS, Model};
use crate::robust::noise::index::{RayIndex, chi2};
use crate::robust::parts::Part;
use crate::robust::scene::sample::scramble;

/// Objects that are taken away together, at most. It bounds the work, and more changed nothing beyond chance where images are sparse (`docs/notes/method.md`).
const MOST_OBJECTS: usize = 6;
/// Rays that propose hypotheses in place of them, for each object. It bounds the work. Each round of the search draws others.
const PROPOSERS: usize = 8;
/// Objects that may have fewer of each other's votes than this are no neighbors. One is shared by chance more easily, and neighbors that share one changed
/// nothing beyond chance where images are sparse (`docs/notes/method.md`).
const LEAST_SHARED: usize = 2;
/// Times that what was born competes among itself. It bounds the work: J judges what has not settled then as it is.
const ROUNDS: usize = 3;
/// Hypotheses of them that are estimated, for each object. The best supported come first, and more changed nothing beyond chance where images are sparse
/// (`docs/notes/method.md`).
const CANDIDATES: usize = 4;
/// Times that a hypothesis is estimated on what votes for it. It bounds the work where votes come and go. What is chosen is estimated once more.
const POLISHINGS: usize = 4;
/// Of more visits, single ones are not tried as parts of an object: one of many moves it little, and the work would grow with the square of the visits. What
/// looks from one side is, however many they are: where two stand back to back, drift explains that the rays of all visits meet between them.
pub const MOST_VISITS: usize = 6;
/// The gate of these votes, as a share of the gate of all. At a gate of four sigmas, 86 % of an object's own detections are within it.
const CLOSE: f64 = 0.5;

/// Repair all neighborhoods; whether any got better. Each `attempt` has other proposers.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn repair(
    model: &Model<'_>,
    lookout: &Lookout,
    index: &RayIndex<'_>,
    objects: Vec<Object>,
    attempt: u64,
    progress: &Progress,
) -> Result<(Vec<Object>, bool), Halt> {
    let claims = claims_of_all(model, index, &objects, progress)?;
    let poses = Trajectories::of(model, &objects);
    let owner = owners(model.scene, &objects);
    let open = neighborhoods(model, &objects, &claims, &owner);
    let mut is_free = vec![true; objects.len()];
    // Neighborhoods without common objects, side by side; an object has one chance per call.
    let mut places: Vec<Vec<usize>> = Vec::new();
    for place in open {
        if place.iter().all(|&i| is_free[i]) {
            for &i in &place {
                is_free[i] = false;
            }
            places.push(place);
        }
    }
    let solve = |place: &Vec<usize>| {
        progress.check()?;
        let old: Vec<&Object> = place.iter().map(|&i| &objects[i]).collect();
        let mut rays: Vec<u32> = old.iter().flat_map(|object| object.votes.iter().copied()).collect();
        let leftover =
            place.iter().flat_map(|&i| &claims[i]).map(|claim| claim.ray).filter(|&ray| owner[ray as usize] == NOBODY);
        rays.extend(leftover);
        rays.sort_unstable();
        rays.dedup();
        anew(&Place { model, lookout, index, poses: &poses, rays: &rays }, &old, attempt, progress)
    };
    let solved: Vec<Option<Vec<Object>>> = places.par_iter().with_max_len(1).map(solve).collect::<Result<_, Halt>>()?;
    Ok(taken_over(objects, &places, solved))
}

/// Objects with those of the places that became others; whether any did. Leftovers at the edge of two places may be wanted by both: the one that comes
/// first has them, and the other stays as it was.
fn taken_over(objects: Vec<Object>, places: &[Vec<usize>], solved: Vec<Option<Vec<Object>>>) -> (Vec<Object>, bool) {
    let mut objects: Vec<Option<Object>> = objects.into_iter().map(Some).collect();
    let (mut taken, mut born, mut any) = (FxHashSet::default(), Vec::new(), false);
    for (place, new) in places.iter().zip(solved) {
        let Some(new) = new else { continue };
        let votes = || new.iter().flat_map(|object| &object.votes);
        if votes().any(|ray| taken.contains(ray)) {
            continue;
        }
        any = true;
        taken.extend(votes().copied());
        for &i in place {
            objects[i] = None;
        }
        born.extend(new);
    }
    let mut kept: Vec<Object> = objects.into_iter().flatten().chain(born).collect();
    kept.sort_by_key(|object| object.votes[0]);
    (kept, any)
}

/// Other objects for the rays of some objects, with less J; nothing if there are none.
fn anew(place: &Place<'_>, old: &[&Object], attempt: u64, progress: &Progress) -> Result<Option<Vec<Object>>, Halt> {
    let (model, rays) = (place.model, place.rays);
    let gate_sigmas = model.settings.gate_sigmas;
    let mut proposers = rays.to_vec();
    proposers.sort_by_cached_key(|&ray| scramble(u64::from(ray) ^ (attempt << 40)));
    proposers.truncate(PROPOSERS * (old.len() + 1));
    let mut hypotheses = propose_among(model, rays, &proposers);
    hypotheses.sort_by(|a, b| b.support.total_cmp(&a.support).then(a.rays.cmp(&b.rays)));
    let mut candidates: Vec<Candidate> = old
        .iter()
        .map(|object| Candidate::new(model, rays, object.class, object.fit.point, object.ln_size, gate_sigmas))
        .collect();
    for hypothesis in &hypotheses {
        if candidates.len() >= old.len() + CANDIDATES * (old.len() + 1) {
            break;
        }
        candidates.extend(
            polished(model, rays, hypothesis).filter(|new| candidates.iter().all(|other| other.votes != new.votes)),
        );
    }
    let as_it_is: Vec<usize> = (0..old.len()).collect();
    let (mut starts, mut twos) = (vec![as_it_is, Vec::new()], Vec::new());
    for (i, object) in old.iter().enumerate() {
        let first = candidates.len();
        for part in parts_of(model, object) {
            for new in candidates_of(model, rays, object, &part) {
                if candidates.iter().all(|other| other.votes != new.votes) {
                    candidates.push(new);
                }
            }
        }
        // One object gives way to two: adding one and dropping one does not get there.
        let two = if model.settings.has(Part::TwoForOne) { best_two(&candidates, rays.len(), first) } else { None };
        twos.extend(two.map(|two| (i, two)));
        if candidates.len() > first {
            starts.push((0..old.len()).filter(|&other| other != i).chain(first..candidates.len()).collect());
        }
    }
    starts.push((old.len()..candidates.len()).collect());
    let before: f64 = old.iter().map(|object| object.energy).sum();
    let mut best: Option<(f64, Vec<Object>)> = None;
    let mut seen: Vec<Vec<usize>> = Vec::new();
    let mut compete = |found: Vec<Object>| {
        let energy: f64 = found.iter().map(|object| object.energy).sum();
        if energy < best.as_ref().map_or(before, |best| best.0) - LEAST_GAIN_OF_MOVE {
            best = Some((energy, found));
        }
    };
    for chosen in starts.into_iter().map(|start| choose(&candidates, rays.len(), start)) {
        if !seen.contains(&chosen) {
            compete(place.objects(&candidates, &chosen, &[], progress)?);
            seen.push(chosen);
        }
    }
    // The others stay as they are: with them all of the place would be decided anew for each of its objects, and mostly in vain.
    for (i, two) in twos {
        let others = || (0..old.len()).filter(|&other| other != i).map(|other| old[other]);
        let mut of_others: Vec<u32> = others().flat_map(|object| object.votes.iter().copied()).collect();
        of_others.sort_unstable();
        let both = place.objects(&candidates, &two, &of_others, progress)?;
        compete(both.into_iter().chain(others().cloned()).collect());
    }
    Ok(best.map(|best| best.1))
}

/// Where objects are destroyed and repaired.
struct Place<'a> {
    model: &'a Model<'a>,
    lookout: &'a Lookout,
    index: &'a RayIndex<'a>,
    poses: &'a Trajectories,
    /// The rays that may vote, ascending.
    rays: &'a [u32],
}

impl Place<'_> {
    /// The objects that some candidates become when they compete, for what others that stay as they are have not (ascending).
    fn objects(
        &self,
        candidates: &[Candidate],
        chosen: &[usize],
        of_others: &[u32],
        progress: &Progress,
    ) -> Result<Vec<Object>, Halt> {
        let Self { model, lookout, index, poses, rays } = *self;
        let is_free = |ray: u32| of_others.binary_search(&ray).is_err();
        let may_vote = |ray: u32| rays.binary_search(&ray).is_ok() && is_free(ray);
        let mut best = vec![(0.0, usize::MAX); rays.len()];
        for &c in chosen {
            for &(ray, gain) in &candidates[c].gains {
                if gain > best[ray].0 && is_free(rays[ray]) {
                    best[ray] = (gain, c);
                }
            }
        }
        let votes_of = |c: usize| -> Vec<u32> {
            rays.iter().zip(&best).filter(|(_, (_, of))| *of == c).map(|(&ray, _)| ray).collect()
        };
        let mut born: Vec<Object> = Vec::new();
        for &c in chosen {
            let votes = votes_of(c);
            if votes.len() >= model.settings.min_votes {
                born.extend(object(model, lookout, votes, candidates[c].point));
            }
        }
        for _ in 0..ROUNDS {
            let (moved, any) = assign_among(model, lookout, index, poses, born, &may_vote, progress)?;
            born = moved;
            if !any {
                break;
            }
        }
        born.retain(|object| object.energy < 0.0);
        Ok(born)
    }
}

/// A point that may be an object: what it gains by which rays, and what it costs without them.
struct Candidate {
    point: Vector3<f64>,
    /// Place in the list of rays, and gain: the best ray of each image.
    gains: Vec<(usize, f64)>,
    /// The rays of these.
    votes: Vec<u32>,
    /// The price of its birth, and of all images that should have seen it.
    cost: f64,
}

impl Candidate {
    fn new(model: &Model<'_>, rays: &[u32], class: u32, point: Vector3<f64>, ln_size: f64, gate_sigmas: f64) -> Self {
        let scene = model.scene;
        let limit = gate_sigmas * gate_sigmas;
        let of_class = &model.classes[class as usize];
        let votes_for = model.votes_for(class);
        let (mut gains, mut farthest): (Vec<(usize, f64)>, f64) = (Vec::new(), 0.0);
        let (mut images, mut last) = (0_usize, u32::MAX);
        let (mut variance_m2, mut seen) = (f64::INFINITY, Vec::new());
        for (place, &ray) in rays.iter().enumerate() {
            let image = scene.image_of(ray);
            if image != last {
                last = image;
                seen.push(image);
            }
            let projected = scene.ray(ray).project(&point);
            let spread = &model.spreads[ray as usize];
            let chi2 = chi2(&projected, spread);
            let is_in_gate = projected.z > 0.0 && chi2 < limit;
            if !is_in_gate || !model.confusions.may_be(class, scene.class_of(ray)) {
                continue;
            }
            let variance = spread.variance(projected.z);
            let gain = votes_for.gain(ray, chi2, variance * variance, projected.z, ln_size);
            if gain <= 0.0 {
                continue;
            }
            farthest = farthest.max(projected.z);
            variance_m2 = variance_m2.min(variance * projected.z * projected.z / scene.scale2[ray as usize]);
            match gains.last_mut() {
                Some((other, most)) if scene.rays.image[rays[*other] as usize] == image => {
                    if gain > *most {
                        (*other, *most) = (place, gain);
                    }
                }
                _ => gains.push((place, gain)),
            }
        }
        for &image in &seen {
            let view = &scene.views[image as usize];
            let near = (view.center - point).norm_squared() <= farthest * farthest;
            images += usize::from(near && scene.is_in_picture(view, &point));
        }
        let votes = gains.iter().map(|&(place, _)| rays[place]).collect();
        // The volume that its position is known to.
        let birth = -model.settings.ln_births_per_m3() - 1.5 * (variance_m2 / gains.len().max(1) as f64).ln();
        let cost = birth.max(0.0) - images as f64 * of_class.rates.log_miss();
        Self { point, gains, votes, cost }
    }
}

/// A hypothesis, estimated on the rays that pass it closely: what lies beside it must not draw it there.
fn polished(model: &Model<'_>, rays: &[u32], hypothesis: &Hypothesis) -> Option<Candidate> {
    let class = model.scene.rays.class[hypothesis.rays[0] as usize];
    let gate_sigmas = model.settings.gate_sigmas;
    let sizes = hypothesis.rays.map(|ray| implied_size(model, ray, &hypothesis.point));
    let (mut point, mut ln_size) = (hypothesis.point, 0.5 * (sizes[0] + sizes[1]));
    let mut votes = Vec::new();
    for _ in 0..POLISHINGS {
        let close = Candidate::new(model, rays, class, point, ln_size, CLOSE * gate_sigmas);
        if close.votes.len() < model.settings.min_votes {
            return None;
        }
        if close.votes == votes {
            break;
        }
        votes = close.votes;
        point = quick_estimate(model.scene, &model.spreads, &votes, point)?;
        ln_size = size_of(model, &votes, &point);
    }
    let candidate = Candidate::new(model, rays, class, point, ln_size, gate_sigmas);
    (candidate.votes.len() >= model.settings.min_votes).then_some(candidate)
}

/// Votes of an object from one visit or one side alone, and from all others: rays of two objects, each seen from one side, meet where none is.
fn parts_of(model: &Model<'_>, object: &Object) -> Vec<Vec<u32>> {
    if !model.settings.has(Part::Halves) {
        return Vec::new();
    }
    let mut groups: Vec<Vec<u32>> = visits(model.scene, &object.votes).map(<[u32]>::to_vec).collect();
    if groups.len() > MOST_VISITS {
        groups.clear();
    }
    let looks = object.votes.iter().map(|&ray| (ray, model.scene.ray(ray).direction));
    groups.extend(by_side(looks, ONE_SIDE_COSINE));
    let others = |group: &Vec<u32>| object.votes.iter().copied().filter(|ray| !group.contains(ray)).collect();
    let mut parts: Vec<Vec<u32>> = groups.iter().map(others).chain(groups.iter().cloned()).collect();
    let least = model.settings.min_votes.max(1);
    parts.retain(|part| (least..object.votes.len()).contains(&part.len()));
    parts.sort();
    parts.dedup();
    parts
}

/// Where some of an object's votes alone put it: from one side size and height tell how far, so the search for it begins there as well.
fn candidates_of(model: &Model<'_>, rays: &[u32], object: &Object, part: &[u32]) -> Vec<Candidate> {
    let class = &model.classes[object.class as usize];
    let starts = [Some(object.fit.point), most_probable(model, part[0], class)];
    let candidate = |start: Vector3<f64>| {
        let point = fit(model, part, start)?.point;
        let ln_size = size_of(model, part, &point);
        Some(Candidate::new(model, rays, object.class, point, ln_size, model.settings.gate_sigmas))
    };
    let candidates = starts.into_iter().flatten().filter_map(candidate);
    candidates.filter(|candidate| candidate.votes.len() >= model.settings.min_votes).collect()
}

/// The two of the candidates from the first on that explain all rays best, whatever they cost: gains without drifts and looks do not tell well
/// whether one is two.
fn best_two(candidates: &[Candidate], rays: usize, first: usize) -> Option<[usize; 2]> {
    let pairs = (first..candidates.len()).flat_map(|a| (a + 1..candidates.len()).map(move |b| [a, b]));
    let valued = pairs.map(|pair| (value_of(candidates, rays, &pair), pair));
    valued.reduce(|best, pair| if pair.0 > best.0 { pair } else { best }).map(|(_, pair)| pair)
}

/// Which candidates explain all rays best, together: local search from a start by adding one, and dropping those that it makes needless
/// (uncapacitated facility location; Charikar and Guha, SIAM J. Comput. 2005).
fn choose(candidates: &[Candidate], rays: usize, start: Vec<usize>) -> Vec<usize> {
    let mut chosen = pruned(candidates, rays, start);
    let mut value = value_of(candidates, rays, &chosen);
    loop {
        let mut best: Option<(f64, Vec<usize>)> = None;
        for c in (0..candidates.len()).filter(|c| !chosen.contains(c)) {
            let trial = pruned(candidates, rays, chosen.iter().copied().chain([c]).collect());
            let of_trial = value_of(candidates, rays, &trial);
            if of_trial > best.as_ref().map_or(value, |best| best.0) + LEAST_GAIN_OF_MOVE {
                best = Some((of_trial, trial));
            }
        }
        let Some((more, trial)) = best else { break };
        (value, chosen) = (more, trial);
    }
    chosen.sort_unstable();
    chosen
}

/// Without those that are not worth their cost beside the others, the least worth first.
fn pruned(candidates: &[Candidate], rays: usize, mut chosen: Vec<usize>) -> Vec<usize> {
    loop {
        let mut best = vec![[0.0_f64; 2]; rays];
        for &c in &chosen {
            for &(ray, gain) in &candidates[c].gains {
                let [first, second] = &mut best[ray];
                if gain > *first {
                    (*second, *first) = (*first, gain);
                } else if gain > *second {
                    *second = gain;
                }
            }
        }
        let lost = |c: usize| {
            let lost = candidates[c].gains.iter().filter(|(ray, gain)| *gain >= best[*ray][0]);
            lost.map(|(ray, _)| best[*ray][0] - best[*ray][1]).sum::<f64>() - candidates[c].cost
        };
        let worst = chosen.iter().map(|&c| (lost(c), c)).min_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)));
        match worst {
            Some((worth, c)) if worth < 0.0 => chosen.retain(|&other| other != c),
            _ => return chosen,
        }
    }
}

fn value_of(candidates: &[Candidate], rays: usize, chosen: &[usize]) -> f64 {
    let mut best = vec![0.0_f64; rays];
    for &c in chosen {
        for &(ray, gain) in &candidates[c].gains {
            best[ray] = best[ray].max(gain);
        }
    }
    best.iter().sum::<f64>() - chosen.iter().map(|&c| candidates[c].cost).sum::<f64>()
}

/// Objects that may have each other's votes: for each object with such neighbors those it shares most with, the most entangled first; and objects that
/// may be two, alone.
fn neighborhoods(model: &Model<'_>, objects: &[Object], claims: &[Vec<Claim>], owner: &[u32]) -> Vec<Vec<usize>> {
    let mut shared: FxHashMap<(usize, usize), usize> = FxHashMap::default();
    for (i, claims) in claims.iter().enumerate() {
        for claim in claims {
            let other = owner[claim.ray as usize];
            if other != NOBODY && other as usize != i {
                let other = other as usize;
                *shared.entry((i.min(other), i.max(other))).or_default() += 1;
            }
        }
    }
    let mut neighbors: Vec<Vec<(usize, usize)>> = vec![Vec::new(); objects.len()];
    for (&(a, b), &count) in &shared {
        if count >= LEAST_SHARED {
            neighbors[a].push((count, b));
            neighbors[b].push((count, a));
        }
    }
    let mut places: Vec<(f64, Vec<usize>)> = Vec::new();
    for (i, mut near) in neighbors.into_iter().enumerate() {
        if near.is_empty() && !fits_badly(&objects[i]) && parts_of(model, &objects[i]).is_empty() {
            continue;
        }
        near.sort_unstable_by(|a, b| b.cmp(a));
        near.truncate(MOST_OBJECTS - 1);
        let entangled: usize = near.iter().map(|(count, _)| count).sum();
        let mut place: Vec<usize> = near.into_iter().map(|(_, other)| other).chain([i]).collect();
        place.sort_unstable();
        places.push((entangled as f64 / objects[i].votes.len() as f64, place));
    }
    places.sort_by(|a, b| b.0.total_cmp(&a.0).then_with(|| a.1.cmp(&b.1)));
    places.into_iter().map(|(_, place)| place).collect()
}

/// Whether the residuals of an object are larger than chance makes them, so that it may be two: chi² with two degrees of freedom per vote.
fn fits_badly(object: &Object) -> bool {
    let n = object.votes.len() as f64;
    object.fit.chi2.iter().sum::<f64>() > 2.0 * n + CHANCE_SIGMAS * 2.0 * n.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robust::energy::anywhere;
    use crate::robust::energy::seen::Seen;

    #[test]
    fn of_two_places_that_want_one_leftover_the_second_stays_as_it_was() {
        let with_votes = |votes: &[u32]| Object { votes: votes.to_vec(), ..anywhere(1, Seen::default(), -10.0) };
        let begun = [[0, 1], [2, 3], [6, 7]].map(|votes| with_votes(&votes)).to_vec();
        let (places, kept) = (vec![vec![0], vec![1], vec![2]], |objects: Vec<Object>| -> Vec<Vec<u32>> {
            objects.into_iter().map(|object| object.votes).collect()
        });
        let solved = vec![Some(vec![with_votes(&[0, 1, 5])]), Some(vec![with_votes(&[2, 3, 5])]), None];
        let (objects, any) = taken_over(begun.clone(), &places, solved);
        assert!(any);
        assert_eq!(kept(objects), [vec![0, 1, 5], vec![2, 3], vec![6, 7]]);
        let (objects, any) = taken_over(begun.clone(), &places, vec![None, None, None]);
        assert!(!any);
        assert_eq!(kept(objects), kept(begun));
    }
}
