//! Merges and swaps: two objects become one, or exchange votes of one side, one visit or from near by, if J falls.
//!
//! Where two objects are seen from two directions, their rays meet in four places. Which of these are objects is decided by J of
//! both objects together, and not vote by vote.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use super::assign::{Claim, claims_of_all, gain_alone};
use super::foresee::Foresight;
use super::repair::MOST_VISITS;
use crate::progress::{Halt, Progress};
use crate::robust::energy::estimate::visits;
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::{
    LEAST_GAIN_OF_MOVE, NOBODY, Object, by_place, by_side, fitting_unseen, object, owners, places,
};
use crate::robust::model::Model;
use crate::robust::noise::index::RayIndex;
use crate::robust::parts::Part;
use crate::robust::scene::sample::scramble;

/// Objects have to do with each other if one of them may have this share of the other's votes. With a smaller one more pairs are fitted, which have less to
/// exchange.
const LEAST_SHARE: f64 = 0.1;
/// So do objects nearer to each other than this share of the range: rays from two directions meet crosswise not far from where they should. In streets it is
/// 3 m: two that had exchanged votes were 1.5 m too near and too far (`docs/notes/method.md`).
const NEAR_SHARE: f64 = 0.05;
/// What looks from directions within this angle of each other looks from one side (cosine of 25 degrees). They turn by about so much as a drive comes from 60 m
/// to 9 m from an object that is 5 m aside.
const SIDE_COSINE: f64 = 0.906;
/// Two objects of a class are no nearer to each other than this share of their size: things are solid, and boxes show their middle to
/// within a fraction of their size. Two objects of real data are half of their size apart (`docs/notes/method.md`).
const EXCLUSIVE_SHARE: f64 = 0.25;

/// What is near is within a half of the farthest distance, and so many times a half of that: from 60 m to 2 m. Nearer than that no rays meet (`min_range_m`).
const NEAR_HALVINGS: i32 = 5;

/// Pairs that were tried in vain, by their votes.
#[derive(Default)]
pub struct TriedPairs(FxHashSet<(u64, u64)>);

/// Merge and exchange as long as J falls; whether it did.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn rearrange_pairs(
    model: &Model<'_>,
    lookout: &Lookout,
    index: &RayIndex<'_>,
    mut objects: Vec<Object>,
    tried: &mut TriedPairs,
    progress: &Progress,
) -> Result<(Vec<Object>, bool), Halt> {
    let mut any = false;
    loop {
        let claims = claims_of_all(model, index, &objects, progress)?;
        let prints: Vec<u64> = objects.iter().map(fingerprint).collect();
        let mut pairs = pairs(model, &objects, &claims);
        pairs.retain(|&(a, b)| !tried.0.contains(&(prints[a], prints[b])));
        let try_one = |&(a, b): &(usize, usize)| {
            progress.check()?;
            Ok(Pair::new(model, lookout, [&objects[a], &objects[b]], [&claims[a], &claims[b]]).best())
        };
        let found: Vec<Option<(f64, Vec<Object>)>> =
            pairs.par_iter().with_max_len(1).map(try_one).collect::<Result<_, Halt>>()?;
        let mut better: Vec<(f64, usize, usize, Vec<Object>)> = Vec::new();
        for (&(a, b), found) in pairs.iter().zip(found) {
            match found {
                Some((change, objects)) => better.push((change, a, b, objects)),
                None => {
                    tried.0.insert((prints[a], prints[b]));
                }
            }
        }
        if better.is_empty() {
            return Ok((objects, any));
        }
        any = true;
        better.sort_by(|x, y| x.0.total_cmp(&y.0).then((x.1, x.2).cmp(&(y.1, y.2))));
        let mut kept: Vec<Option<Object>> = objects.into_iter().map(Some).collect();
        for (_, a, b, new) in better {
            if kept[a].is_some() && kept[b].is_some() {
                (kept[a], kept[b]) = (None, None);
                kept.extend(new.into_iter().map(Some));
            }
        }
        objects = kept.into_iter().flatten().collect();
        objects.sort_by_key(|object| object.votes[0]);
    }
}

/// Make one of objects that are nearer to each other than solid things can be: a detector that shows one thing twice, or whose boxes have their
/// middle elsewhere from another side, makes no second one.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn exclude(
    model: &Model<'_>,
    lookout: &Lookout,
    index: &RayIndex<'_>,
    mut objects: Vec<Object>,
    progress: &Progress,
) -> Result<Vec<Object>, Halt> {
    loop {
        progress.check()?;
        let points: Vec<Vector3<f64>> = objects.iter().map(|object| object.fit.point).collect();
        let near = too_near(&objects, &points);
        if near.is_empty() {
            return Ok(objects);
        }
        objects = as_one(model, lookout, index, objects, near, progress)?;
    }
}

/// Objects of which those of some pairs are one, the first pairs first; the weaker of two that cannot be is left out.
pub(crate) fn as_one(
    model: &Model<'_>,
    lookout: &Lookout,
    index: &RayIndex<'_>,
    objects: Vec<Object>,
    pairs: Vec<(usize, usize)>,
    progress: &Progress,
) -> Result<Vec<Object>, Halt> {
    let mut kept: Vec<Option<Object>> = objects.into_iter().map(Some).collect();
    for (a, b) in pairs {
        let (Some(first), Some(second)) = (&kept[a], &kept[b]) else { continue };
        let claims = claims_of_all(model, index, &[first.clone(), second.clone()], progress)?;
        let pair = Pair::new(model, lookout, [first, second], [&claims[0], &claims[1]]);
        let (weaker, class) = if first.votes.len() < second.votes.len() { (a, second.class) } else { (b, first.class) };
        // A detector takes one thing for another now and then: the class with more votes has the place.
        let merged = if may_be_one(model, first, second) { pair.merged() } else { None };
        let merged = merged.filter(|merged| merged.class == class && merged.energy < 0.0);
        kept[weaker] = None;
        if let Some(merged) = merged {
            (kept[a], kept[b]) = (None, None);
            kept.push(Some(merged));
        }
    }
    let mut left: Vec<Object> = kept.into_iter().flatten().collect();
    left.sort_by_key(|object| object.votes[0]);
    Ok(left)
}

/// Pairs of objects at some points that are nearer to each other than solid things can be, the nearest first.
pub(crate) fn too_near(objects: &[Object], points: &[Vector3<f64>]) -> Vec<(usize, usize)> {
    let tree = places::by_place(points.iter().copied());
    let mut near: Vec<(f64, usize, usize)> = Vec::new();
    for (i, (object, point)) in objects.iter().zip(points).enumerate() {
        let reach = EXCLUSIVE_SHARE * object.ln_size.exp();
        if reach.is_finite() {
            let others = tree.locate_within_distance((*point).into(), reach * reach);
            let apart = |other: usize| (points[other] - point).norm();
            near.extend(others.filter(|o| o.data != i).map(|o| (apart(o.data), i.min(o.data), i.max(o.data))));
        }
    }
    near.sort_by(|x, y| x.0.total_cmp(&y.0).then((x.1, x.2).cmp(&(y.1, y.2))));
    near.into_iter().map(|(_, a, b)| (a, b)).collect()
}

/// How near to each other two are that may have each other's votes, m.
pub(crate) fn near_m(model: &Model<'_>) -> f64 {
    NEAR_SHARE * model.settings.viability.max_range_m
}

/// Whether two objects may be one by their classes.
pub(crate) fn may_be_one(model: &Model<'_>, a: &Object, b: &Object) -> bool {
    model.confusions.may_be(a.class, b.class) || model.confusions.may_be(b.class, a.class)
}

/// Pairs of objects of which one may have some of what the other has.
fn pairs(model: &Model<'_>, objects: &[Object], claims: &[Vec<Claim>]) -> Vec<(usize, usize)> {
    let owner = owners(model.scene, objects);
    let mut shared: FxHashMap<(usize, usize), usize> = FxHashMap::default();
    for (i, claims) in claims.iter().enumerate() {
        for claim in claims {
            let other = owner[claim.ray as usize];
            if other != NOBODY && other as usize != i {
                *shared.entry((i, other as usize)).or_default() += 1;
            }
        }
    }
    let enough =
        |&((_, of), count): &(&(usize, usize), &usize)| *count as f64 >= LEAST_SHARE * objects[*of].votes.len() as f64;
    let mut pairs: Vec<(usize, usize)> =
        shared.iter().filter(enough).map(|(&(a, b), _)| (a.min(b), a.max(b))).collect();
    // Where rays of two objects from two directions meet crosswise, neither is in the other's gate.
    let reach_m = near_m(model);
    let tree = by_place(objects);
    for (i, object) in objects.iter().enumerate() {
        let near = tree.locate_within_distance(object.fit.point.into(), reach_m * reach_m).map(|near| near.data);
        pairs.extend(
            near.filter(|&other| other > i && may_be_one(model, &objects[other], object)).map(|other| (i, other)),
        );
    }
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

/// Two objects and what they may have.
struct Pair<'a> {
    model: &'a Model<'a>,
    lookout: &'a Lookout,
    of: [&'a Object; 2],
    /// The rays that each may have.
    gates: [FxHashSet<u32>; 2],
}

impl<'a> Pair<'a> {
    fn new(model: &'a Model<'a>, lookout: &'a Lookout, of: [&'a Object; 2], claims: [&[Claim]; 2]) -> Self {
        let gates = claims.map(|claims| claims.iter().map(|claim| claim.ray).collect());
        Self { model, lookout, of, gates }
    }

    /// Both as one, if that lowers J; else the exchange that lowers it most. And by how much.
    fn best(&self) -> Option<(f64, Vec<Object>)> {
        let before: f64 = self.of.iter().map(|object| object.energy).sum();
        let better = |found: Vec<Object>| {
            let change = found.iter().map(|object| object.energy).sum::<f64>() - before;
            (change < -LEAST_GAIN_OF_MOVE).then_some((change, found))
        };
        let merged = if self.model.settings.has(Part::Merging) { self.merged() } else { None };
        if let Some(merged) = merged.and_then(|object| better(vec![object])) {
            return Some(merged);
        }
        let mut foresight = Foresight::new(self.model, self.lookout, self.of);
        let (parts, near) = self.parts();
        let (mut found, mut helpful) = (Vec::new(), Vec::new());
        for part in &parts {
            let Some(votes) = self.exchanged(part) else { continue };
            if foresight.as_mut().is_none_or(|foresight| foresight.may_help(&votes))
                && let Some(exchange) = self.with_votes(votes, self.of, before).and_then(better)
            {
                found.push(exchange);
                helpful.push(part.clone());
            }
        }
        for part in &near {
            let Some(votes) = self.exchanged(part) else { continue };
            if let Some(foresight) = &mut foresight {
                let Some(both) = foresight.unseen(&votes) else { continue };
                if !foresight.may_help(&self.settled(&both)) {
                    continue;
                }
            }
            let Some(both) = self.unseen_with_votes(votes, self.of) else { continue };
            found.extend(self.with_votes(self.settled(&both), [&both[0], &both[1]], before).and_then(better));
        }
        // What helps on one visit each, helps most on all of them.
        if helpful.len() > 1 {
            let mut images = helpful.concat();
            images.sort_unstable();
            images.dedup();
            found.extend(
                self.exchanged(&images).and_then(|votes| self.with_votes(votes, self.of, before)).and_then(better),
            );
        }
        found.into_iter().reduce(|best, found| if found.0 < best.0 { found } else { best })
    }

    /// Both as one.
    fn merged(&self) -> Option<Object> {
        let larger = if self.of[0].votes.len() >= self.of[1].votes.len() { self.of[0] } else { self.of[1] };
        let mut votes: Vec<(u32, f64, u32)> = self
            .of
            .iter()
            .flat_map(|object| &object.votes)
            .map(|&ray| (self.model.scene.rays.image[ray as usize], gain_alone(self.model, larger, ray), ray))
            .collect();
        votes.sort_by(|x, y| x.0.cmp(&y.0).then(y.1.total_cmp(&x.1)).then(x.2.cmp(&y.2)));
        votes.dedup_by_key(|vote| vote.0);
        let mut votes: Vec<u32> = votes.into_iter().map(|vote| vote.2).collect();
        votes.sort_unstable();
        object(self.model, self.lookout, votes, larger.fit.point)
    }

    /// Images, ascending, whose votes may be exchanged together: those of a visit, and those that look from one side; all of them, and those that show
    /// only one of the two which might as well be the other. Then those that are near, about: each image is to decide once more.
    fn parts(&self) -> (Vec<Vec<u32>>, Vec<Vec<u32>>) {
        let scene = self.model.scene;
        let mut votes: Vec<u32> = self.of.iter().flat_map(|object| object.votes.iter().copied()).collect();
        votes.sort_unstable();
        let middle = 0.5 * (self.of[0].fit.point + self.of[1].fit.point);
        let images = |votes: &[u32]| {
            let mut images: Vec<u32> = votes.iter().map(|&ray| scene.rays.image[ray as usize]).collect();
            images.dedup();
            images
        };
        let of_visits: Vec<Vec<u32>> = visits(scene, &votes).map(images).collect();
        let looks = votes.iter().map(|&ray| (ray, (scene.ray(ray).center - middle).normalize()));
        let of_sides: Vec<Vec<u32>> = by_side(looks, SIDE_COSINE).iter().map(|votes| images(votes)).collect();
        let has = |part: Part| self.model.settings.has(part);
        let contested: Vec<Vec<u32>> =
            (0..2).filter(|_| has(Part::ContestedExchanges)).map(|i| self.contested(i)).collect();
        let among = |part: &Vec<u32>, contested: &Vec<u32>| -> Vec<u32> {
            part.iter().copied().filter(|image| contested.binary_search(image).is_ok()).collect()
        };
        // One of many visits moves an object little: what is contested on it alone is not worth the work.
        let few_visits = of_visits.iter().filter(|_| of_visits.len() <= MOST_VISITS);
        let small: Vec<&Vec<u32>> = of_sides.iter().chain(few_visits).collect();
        let of_contested: Vec<Vec<u32>> =
            small.iter().flat_map(|part| contested.iter().map(|contested| among(part, contested))).collect();
        let near =
            small.iter().filter(|_| has(Part::NearExchanges)).flat_map(|part| self.nearer(part, &middle)).collect();
        let mut parts = [of_contested, contested].concat();
        if has(Part::Exchanges) {
            parts.extend(of_visits.into_iter().chain(of_sides));
        }
        let each = |mut parts: Vec<Vec<u32>>| {
            parts.retain(|part| !part.is_empty());
            parts.sort_unstable();
            parts.dedup();
            parts
        };
        (each(parts), each(near))
    }

    /// Of some images, ascending, those within a half of the distance of the farthest from a point, within a quarter, and so on: where two objects have
    /// exchanged what is seen of them from near, both lie where rays cross, too near or too far.
    fn nearer(&self, images: &[u32], point: &Vector3<f64>) -> Vec<Vec<u32>> {
        let distance_m = |image: u32| (self.model.scene.views[image as usize].center - point).norm();
        let farthest_m = images.iter().map(|&image| distance_m(image)).fold(0.0, f64::max);
        let within = |m: f64| -> Vec<u32> { images.iter().copied().filter(|&image| distance_m(image) <= m).collect() };
        (1..=NEAR_HALVINGS).map(|halvings| within(farthest_m * 0.5_f64.powi(halvings))).collect()
    }

    /// The images, ascending, that show one of the two and not the other, whose vote there might as well be the other's.
    fn contested(&self, of: usize) -> Vec<u32> {
        let image = |ray: &u32| self.model.scene.rays.image[*ray as usize];
        let shown: FxHashSet<u32> = self.of[1 - of].votes.iter().map(image).collect();
        let votes =
            self.of[of].votes.iter().filter(|ray| self.gates[1 - of].contains(ray) && !shown.contains(&image(ray)));
        votes.map(image).collect()
    }

    /// The votes of both (ascending) after an exchange of what they have in some images, as far as they may take it; nothing if that is no exchange.
    ///
    /// To exchange most of what two have is to exchange the rest, by other names: so each stays about where it is, with its claims.
    fn exchanged(&self, images: &[u32]) -> Option<[Vec<u32>; 2]> {
        let image = |ray: u32| self.model.scene.rays.image[ray as usize];
        let is_within = |ray: u32| images.binary_search(&image(ray)).is_ok();
        let votes = || self.of.iter().flat_map(|object| &object.votes);
        let is_rest = 2 * votes().filter(|&&ray| is_within(ray)).count() > votes().count();
        let split = |barred: &FxHashSet<u32>| {
            let goes = |ray: u32| is_within(ray) != is_rest && !barred.contains(&image(ray));
            self.of.map(|object| object.votes.iter().copied().partition::<Vec<u32>, _>(|&ray| goes(ray)))
        };
        let [mut a, mut b] = split(&FxHashSet::default());
        let barred: FxHashSet<u32> =
            self.barred(0, &a.1, &b.0).chain(self.barred(1, &b.1, &a.0)).map(|ray| image(*ray)).collect();
        if !barred.is_empty() {
            [a, b] = split(&barred);
        }
        // What has no votes left, and what takes all of the other's, are the two as they are.
        if a.0.len() + b.0.len() == 0 || a.1.len() + b.1.len() == 0 {
            return None;
        }
        Some([[a.1, b.0].concat(), [b.1, a.0].concat()].map(sorted))
    }

    /// Both with some votes (ascending) each, from where two objects are; nothing if that is not two objects, or if J of both is not below `most`.
    fn with_votes(&self, votes: [Vec<u32>; 2], from: [&Object; 2], most: f64) -> Option<Vec<Object>> {
        // J is not less than that of an object before it is asked who should have seen it.
        let unseen = self.unseen_with_votes(votes, from);
        let unseen = unseen.filter(|both| both.iter().map(|object| object.energy).sum::<f64>() < most)?;
        let with_looks = |object: Object| object.with_looks(self.model, self.lookout);
        let found: Vec<Object> = unseen.into_iter().map(with_looks).collect::<Option<_>>()?;
        found.iter().all(|object| object.energy < 0.0).then_some(found)
    }

    /// The same before it is asked who should have seen them.
    fn unseen_with_votes(&self, votes: [Vec<u32>; 2], from: [&Object; 2]) -> Option<Vec<Object>> {
        let is_enough = |votes: &Vec<u32>| votes.len() >= self.model.settings.min_votes as usize;
        if !votes.iter().all(is_enough) {
            return None;
        }
        votes.into_iter().zip(from).map(|(votes, from)| fitting_unseen(self.model, votes, from.fit.point)).collect()
    }

    /// The votes (ascending) that each of two explains best, image by image, of those that they have.
    fn settled(&self, both: &[Object]) -> [Vec<u32>; 2] {
        let mut of_image: BTreeMap<u32, [Option<u32>; 2]> = BTreeMap::new();
        for (i, object) in both.iter().enumerate() {
            for &ray in &object.votes {
                of_image.entry(self.model.scene.rays.image[ray as usize]).or_default()[i] = Some(ray);
            }
        }
        let gain = |i: usize, ray: Option<u32>| ray.map_or(0.0, |ray| gain_alone(self.model, &both[i], ray));
        let mut votes = [Vec::new(), Vec::new()];
        for [a, b] in of_image.into_values() {
            let is_other = gain(0, b) + gain(1, a) > gain(0, a) + gain(1, b);
            let [first, second] = if is_other { [b, a] } else { [a, b] };
            votes[0].extend(first);
            votes[1].extend(second);
        }
        votes.map(sorted)
    }

    /// Which of some votes one may not take that keeps others: on many visits it stays where it is, so they have to be in its gate there.
    fn barred<'v>(&'v self, one: usize, kept: &[u32], taken: &'v [u32]) -> impl Iterator<Item = &'v u32> {
        let is_free = visits(self.model.scene, kept).count() <= MOST_VISITS;
        taken.iter().filter(move |ray| !is_free && !self.gates[one].contains(ray))
    }
}

fn sorted(mut votes: Vec<u32>) -> Vec<u32> {
    votes.sort_unstable();
    votes
}

fn fingerprint(object: &Object) -> u64 {
    object.votes.iter().fold(0, |sum, &ray| scramble(sum ^ u64::from(ray)))
}

#[cfg(test)]
mod tests {
    use nalgebra::Isometry3;

    use super::*;
    use crate::robust::noise::Noise;
    use crate::street;

    #[test]
    fn what_a_visit_shows_of_one_of_two_neighbors_alone_goes_to_that_one() -> Result<(), Halt> {
        let errors: Vec<[f64; 2]> = (0..97).map(|i| [(f64::from(i) * 1.7).sin(), (f64::from(i) * 2.3).cos()]).collect();
        let both = [Vector3::new(30.0, 4.0, 3.0), Vector3::new(30.0, 5.0, 3.0)];
        // Two drives see both, and one that crosses them sees the second alone, which is as far ahead of it as the first is of the others.
        let crossing = Isometry3::new(Vector3::new(34.0, -25.0, 0.0), Vector3::z() * std::f64::consts::FRAC_PI_2);
        let drive = |i: usize| street::street(10, 2.0, &both, &errors[7 * i..]);
        let scene = street::joined(vec![
            drive(0),
            drive(1),
            street::moved(street::street(10, 2.0, &both[..1], &errors[14..]), &crossing),
        ]);
        let mut model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let rays = scene.usable_rays();
        let (of_both, of_one): (Vec<u32>, Vec<u32>) = rays.iter().partition(|&&ray| scene.view(ray).pass < 2);
        let every_other =
            |rays: &[u32], first: usize| -> Vec<u32> { rays.iter().copied().skip(first).step_by(2).collect() };
        let votes = |i: usize| [every_other(&of_both, i), every_other(&of_one, i)].concat();
        let of = |model: &Model<'_>| -> Vec<Object> {
            (0..2).filter_map(|i| object(model, &lookout, votes(i), both[i])).collect()
        };
        let begun = of(&model);
        crate::robust::learn::learn(&mut model, &lookout, &rays, &begun);
        let index = RayIndex::new(&scene, &model.spreads, street::GATE_SIGMAS, rays.iter().copied());
        let (model, mut tried) = (&model, TriedPairs::default());
        let (found, is_better) = rearrange_pairs(model, &lookout, &index, of(model), &mut tried, &Progress::default())?;
        assert!(is_better);
        assert_eq!(found[0].votes, every_other(&of_both, 0));
        assert_eq!(found[1].votes, [every_other(&of_both, 1), of_one].concat());
        Ok(())
    }

    #[test]
    fn what_two_neighbors_have_exchanged_from_near_they_exchange_back() -> Result<(), Halt> {
        let errors: Vec<[f64; 2]> = (0..97).map(|i| [(f64::from(i) * 1.7).sin(), (f64::from(i) * 2.3).cos()]).collect();
        let both = [Vector3::new(48.0, 3.0, 3.0), Vector3::new(48.0, 3.6, 3.0)];
        let drive = |i: usize| street::street(45, 1.0, &both, &errors[7 * i..]);
        let scene = street::joined(vec![drive(0), drive(1)]);
        let noise = Noise { position_m: 0.1, position_drift_m: 0.15, ..street::NOISE };
        let mut model = Model::new(&scene, &noise, &street::SETTINGS);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let rays = scene.usable_rays();
        // Rays alternate; within 15 m each has what the other shows.
        let is_near = |ray: u32| (scene.ray(ray).center - both[0]).norm() < 15.0;
        let swapped = |i: usize| -> Vec<u32> {
            rays.iter()
                .copied()
                .enumerate()
                .filter(|&(k, ray)| (k + usize::from(is_near(ray))) % 2 == i)
                .map(|(_, ray)| ray)
                .collect()
        };
        let of = |model: &Model<'_>| -> Vec<Object> {
            (0..2).filter_map(|i| object(model, &lookout, swapped(i), both[i])).collect()
        };
        let begun = of(&model);
        crate::robust::learn::learn(&mut model, &lookout, &rays, &begun);
        let index = RayIndex::new(&scene, &model.spreads, street::GATE_SIGMAS, rays.iter().copied());
        let (model, mut tried) = (&model, TriedPairs::default());
        let (found, _) = rearrange_pairs(model, &lookout, &index, of(model), &mut tried, &Progress::default())?;
        for (i, object) in found.iter().enumerate() {
            assert!(object.votes.iter().all(|ray| *ray as usize % 2 == i));
            assert!(object.votes.len() >= rays.len() / 2 - 2);
        }
        Ok(())
    }

    #[test]
    fn to_exchange_most_of_what_two_have_is_to_exchange_the_rest() -> Result<(), Halt> {
        let errors: Vec<[f64; 2]> = (0..97).map(|i| [(f64::from(i) * 1.7).sin(), (f64::from(i) * 2.3).cos()]).collect();
        let both = [Vector3::new(30.0, 4.0, 3.0), Vector3::new(30.0, 5.0, 3.0)];
        let scene = street::joined((0..3).map(|i| street::street(10, 2.0, &both, &errors[7 * i..])).collect());
        let model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let rays = scene.usable_rays();
        let votes = |i: usize| rays.iter().copied().skip(i).step_by(2).collect();
        let objects: Vec<Object> = (0..2).filter_map(|i| object(&model, &lookout, votes(i), both[i])).collect();
        let index = RayIndex::new(&scene, &model.spreads, street::GATE_SIGMAS, rays.iter().copied());
        let claims = claims_of_all(&model, &index, &objects, &Progress::default())?;
        let pair = Pair::new(&model, &lookout, [&objects[0], &objects[1]], [&claims[0], &claims[1]]);
        let (one, rest): (Vec<u32>, Vec<u32>) = (0..30).partition(|&image| scene.views[image as usize].pass == 0);
        let exchanged = pair.exchanged(&rest);
        assert_eq!(exchanged, pair.exchanged(&one));
        // Each keeps what it has on two of three drives.
        let is_own = |ray: &&u32| objects[0].votes.binary_search(ray).is_ok();
        assert_eq!(exchanged.map(|[first, _]| first.iter().filter(is_own).count()), Some(20));
        Ok(())
    }

    #[test]
    fn what_an_object_of_many_visits_may_not_take_it_could_not_keep() -> Result<(), Halt> {
        let errors: Vec<[f64; 2]> = (0..97).map(|i| [(f64::from(i) * 1.7).sin(), (f64::from(i) * 2.3).cos()]).collect();
        let (mut taken, mut refused) = (0, 0);
        for apart_m in [0.05, 0.1, 0.2, 0.4, 1.0, 2.5] {
            let first = Vector3::new(30.0, 4.0, 3.0);
            let both = [first, first + Vector3::y() * apart_m];
            let drive = |i: usize| street::street(10, 2.0, &both, &errors[7 * i..]);
            let scene = street::joined((0..MOST_VISITS + 2).map(drive).collect());
            let mut model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
            let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
            let rays = scene.usable_rays();
            let of = |model: &Model<'_>| -> Vec<Object> {
                let votes = |i: usize| rays.iter().copied().skip(i).step_by(2).collect();
                (0..2).filter_map(|i| object(model, &lookout, votes(i), both[i])).collect()
            };
            let begun = of(&model);
            crate::robust::learn::learn(&mut model, &lookout, &rays, &begun);
            let objects = of(&model);
            let index = RayIndex::new(&scene, &model.spreads, street::GATE_SIGMAS, rays.iter().copied());
            let claims = claims_of_all(&model, &index, &objects, &Progress::default())?;
            let pair = Pair::new(&model, &lookout, [&objects[0], &objects[1]], [&claims[0], &claims[1]]);
            let visit = |votes: &[u32]| -> [Vec<u32>; 2] {
                votes.iter().copied().partition::<Vec<u32>, _>(|&ray| scene.view(ray).pass > 0).into()
            };
            let [kept, _] = visit(&objects[0].votes);
            let [_, other] = visit(&objects[1].votes);
            let mut votes = [kept.clone(), other.clone()].concat();
            votes.sort_unstable();
            let after = object(&model, &lookout, votes, first);
            let limit = street::GATE_SIGMAS.powi(2);
            let is_kept = after.is_some_and(|after| after.fit.chi2.iter().all(|chi2| *chi2 <= limit));
            let may = pair.barred(0, &kept, &other).count() == 0;
            assert!(may || !is_kept, "{apart_m}");
            (taken, refused) = (taken + usize::from(may), refused + usize::from(!may));
            // On few visits it may move to where they are.
            let few: Vec<u32> = kept.iter().copied().filter(|&ray| scene.view(ray).pass == 1).collect();
            assert!(pair.barred(0, &few, &other).count() == 0);
        }
        assert!(taken > 0 && refused > 0, "{taken} {refused}");
        Ok(())
    }

    #[test]
    fn of_two_that_no_place_has_room_for_the_stronger_stays_if_both_as_one_are_none() -> Result<(), Halt> {
        let both = [Vector3::new(30.0, 4.0, 3.0), Vector3::new(30.0, 4.05, 3.0)];
        let scene = street::joined((0..2).map(|_| street::street(10, 2.0, &both, &[[0.2, -0.1]])).collect());
        let mut model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let rays = scene.usable_rays();
        // One image shows the second alone.
        let of_first = rays.iter().copied().step_by(2).enumerate().filter(|(image, _)| *image != 3).map(|(_, ray)| ray);
        let votes: [Vec<u32>; 2] = [of_first.collect(), rays.iter().copied().skip(1).step_by(2).take(6).collect()];
        let of = |(votes, at): (Vec<u32>, &Vector3<f64>)| object(&model, &lookout, votes, *at);
        let objects: Vec<Object> = votes.into_iter().zip(&both).filter_map(of).collect();
        let index = RayIndex::new(&scene, &model.spreads, street::GATE_SIGMAS, rays.iter().copied());
        let as_one =
            |model: &Model<'_>| as_one(model, &lookout, &index, objects.clone(), vec![(0, 1)], &Progress::default());
        assert_eq!(as_one(&model)?.iter().map(|one| one.votes.len()).collect::<Vec<_>>(), [20]);
        // No object is worth its price.
        model.classes[0].ln_clutter_per_sr = 40.0;
        let left = as_one(&model)?;
        assert_eq!(left.iter().map(|object| &object.votes).collect::<Vec<_>>(), [&objects[0].votes]);
        Ok(())
    }
}
