//! Swaps: which of two neighbours has the votes of some direction, or whether there is only one object.
//!
//! Where images show only one of two neighbours from some direction, the wrong one may have all those votes. Its position has
//! then moved so that they fit, the detections that it should have fit nowhere, and no single vote changes sides. Both are
//! estimated anew as if the other one had these votes, with the unassigned detections that then fit, and the explanation that
//! leaves less unexplained stays. Where one label explains nearly all that both do, and hardly any image shows both, there is one
//! object.

use nalgebra::Vector3;
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use super::adjust::PLACE_M;
use super::associate::Association;
use super::label::{Label, by_place, direction_to, from_voters, sector_middles};
use super::pairs::{nearest_pairs, replaced};
use crate::progress::{Halt, Progress};
use crate::robust::energy::estimate::{Care, Joint, Limits, Start};
use crate::robust::energy::looks::SECTOR_COSINE;
use crate::robust::model::Model;
use crate::robust::parts::Part;
use crate::robust::search::rearrange::near_m;

/// So many images must show one of the two alone from about one direction. As many must show both for an exchange (`untangle`).
const LEAST_ALONE: usize = 6;
/// For each of them, images that show both from there, at most. It spares trials: what is tried must explain more.
const MOST_BOTH: f64 = 0.2;
/// This part of them must be in the other's gate. Otherwise most of them would not fit there.
const CLAIMED_SHARE: f64 = 0.5;
/// Other labels of their place that are estimated with the two, at most: they tell the drift of the passes. The work grows with the square of their number.
const COMPANIONS: usize = 5;
/// Times that detections nobody has are gathered, without companions and with them. Without them it is asked only what is worth a try.
const GATHERINGS: (usize, usize) = (1, 2);
/// Swaps that explain so much less without companions are not tried with them. Two votes without a residual explain about as much, with a gate of four sigmas.
const PROMISING: f64 = -30.0;
/// A swap must explain so much more. It is 150 times more probable then, as squared sigmas are twice the logarithm.
const LEAST_GAIN: f64 = 10.0;
/// For each image that shows the one with fewer votes, images that show both, at most, for them to be one object. It is less than where positions agree
/// (`SHARED_IMAGES`), as these need not.
const MOST_SHARED: f64 = 0.05;
/// One object may explain so much less for each vote of the one with fewer votes; how much without companions for it to be
/// worth a try with them. By chance a vote has a squared residual of 2: of that a quarter, and three quarters.
const MOST_LOST: f64 = 0.5;
const MAYBE_LOST: f64 = 1.5;

/// Make one of two neighbors, or give the other what it explains better; whether there was anything. The nearest
/// pairs first, each label in one pair; other pairs once these are best as they are.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn swap_votes(
    model: &Model<'_>,
    association: &Association<'_>,
    mut labels: Vec<Label>,
    progress: &Progress,
) -> Result<(Vec<Label>, bool), Halt> {
    let is_open = |a: &Label, b: &Label| a.class == b.class && !a.known.satisfied.contains(&b.identity());
    loop {
        let pairs = nearest_pairs(&labels, near_m(model), is_open);
        if pairs.is_empty() {
            return Ok((labels, false));
        }
        let better = better_pairs(model, association, &labels, &pairs, progress)?;
        let is_any = better.iter().any(Option::is_some);
        labels = replaced(labels, &pairs, better, |known, neighbor| known.satisfied.push(neighbor));
        if is_any {
            return Ok((labels, true));
        }
    }
}

/// What some disjoint pairs of labels are better; nothing for those that are best as they are.
fn better_pairs(
    model: &Model<'_>,
    association: &Association<'_>,
    labels: &[Label],
    pairs: &[(usize, usize)],
    progress: &Progress,
) -> Result<Vec<Option<Vec<Label>>>, Halt> {
    let mut is_taken = vec![false; association.scene.rays.rays.len()];
    for &ray in labels.iter().flat_map(|label| &label.voters) {
        is_taken[ray as usize] = true;
    }
    let tree = by_place(labels);
    let of_pair = |&(a, b): &(usize, usize)| {
        progress.check()?;
        let near = tree.nearest_neighbor_iter_with_distance_2(labels[a].estimate.point.into());
        let near = near.take_while(|(_, distance2)| *distance2 <= PLACE_M * PLACE_M).map(|(near, _)| near.data);
        let companions = near.filter(|&i| i != a && i != b).take(COMPANIONS).map(|i| &labels[i]).collect();
        Ok(Pair { model, association, is_taken: &is_taken, labels: [&labels[a], &labels[b]], companions }.better())
    };
    pairs.par_iter().with_max_len(1).map(of_pair).collect()
}

/// Two neighbors.
struct Pair<'a> {
    model: &'a Model<'a>,
    association: &'a Association<'a>,
    /// Of each ray, whether a label has it.
    is_taken: &'a [bool],
    labels: [&'a Label; 2],
    companions: Vec<&'a Label>,
}

/// Votes (ascending) that one of the two has from about one direction, or all such votes.
struct Swap {
    from: usize,
    rays: Vec<u32>,
}

/// Who has which votes, and what is gained by that: the squared gate for each of them, less its squared residual in sigmas.
struct Explanation {
    voters: [Vec<u32>; 2],
    points: [Vector3<f64>; 2],
    gain: f64,
}

/// A vote from its direction, and whether its image shows the other label as well.
struct Sighting {
    ray: u32,
    direction: Vector3<f64>,
    shows_both: bool,
}

impl Pair<'_> {
    /// What the two are better; nothing if they are best as they are.
    fn better(&self) -> Option<Vec<Label>> {
        let [of_first, of_second] = [0, 1].map(|from| self.swaps(from));
        let as_one = self.as_one();
        if of_first.is_empty() && of_second.is_empty() && as_one.is_none() {
            return None;
        }
        let voters = self.labels.map(|label| label.voters.clone());
        let alone = self.explain(voters.clone(), &[])?;
        let gains = |voters: &[Vec<u32>; 2], least: f64| {
            self.explain(voters.clone(), &[]).is_some_and(|after| after.gain > alone.gain + least)
        };
        let promising = |swaps: Vec<Swap>| -> Vec<Swap> {
            swaps.into_iter().filter(|swap| gains(&self.after(&[swap]), PROMISING)).collect()
        };
        let [of_first, of_second] = [of_first, of_second].map(promising);
        let each = of_first.iter().chain(&of_second).map(|swap| self.after(&[swap]));
        let both = of_first.iter().flat_map(|a| of_second.iter().map(|b| self.after(&[a, b])));
        let tried: Vec<[Vec<u32>; 2]> = each.chain(both).collect();
        let smaller = voters[0].len().min(voters[1].len()) as f64;
        let as_one = as_one.filter(|as_one| gains(as_one, -MAYBE_LOST * smaller));
        if tried.is_empty() && as_one.is_none() {
            return None;
        }
        // Companions that cannot be estimated must not keep these two as they are.
        let (as_is, companions) = match self.explain(voters, &self.companions) {
            Some(as_is) => (as_is, self.companions.as_slice()),
            None => (alone, &[][..]),
        };
        let one = as_one.and_then(|voters| self.explain(voters, companions));
        if let Some(one) = one.filter(|one| one.gain > as_is.gain - MOST_LOST * smaller) {
            let side = usize::from(one.voters[0].is_empty());
            return Some(vec![self.label(side, &one)?]);
        }
        let explained = tried.into_iter().filter_map(|voters| self.explain(voters, companions));
        let best = explained.max_by(|a, b| a.gain.total_cmp(&b.gain))?;
        if !(best.gain > as_is.gain + LEAST_GAIN) {
            return None;
        }
        Some(vec![self.label(0, &best)?, self.label(1, &best)?])
    }

    /// The votes of the two after some swaps.
    fn after(&self, swaps: &[&Swap]) -> [Vec<u32>; 2] {
        let mut voters = self.labels.map(|label| label.voters.clone());
        for Swap { from, rays } in swaps {
            voters[*from].retain(|ray| rays.binary_search(ray).is_err());
            voters[1 - from].extend(rays);
        }
        voters
    }

    /// All votes for the one with more, unless too many images show both; of these its own stay.
    fn as_one(&self) -> Option<[Vec<u32>; 2]> {
        let scene = self.association.scene;
        let smaller = usize::from(self.labels[1].voters.len() <= self.labels[0].voters.len());
        let [few, many] = [smaller, 1 - smaller].map(|side| self.labels[side]);
        let shown = many.images(scene);
        let is_new = |ray: &&u32| shown.binary_search(&scene.rays.image[**ray as usize]).is_err();
        let new: Vec<u32> = few.voters.iter().filter(is_new).copied().collect();
        let shared = few.voters.len() - new.len();
        let mut voters = [Vec::new(), Vec::new()];
        voters[1 - smaller] = [many.voters.as_slice(), &new].concat();
        let may_be_one = shared as f64 <= MOST_SHARED * few.voters.len() as f64;
        (may_be_one && self.model.settings.has(Part::Merging)).then_some(voters)
    }

    /// What one of the two might give away: what looks from one direction, for each, or all that.
    fn swaps(&self, from: usize) -> Vec<Swap> {
        let sightings = self.sightings(from);
        let alone = || sightings.iter().filter(|sighting| !sighting.shows_both);
        let mut swaps = Vec::new();
        for middle in sector_middles(alone().map(|sighting| sighting.direction)) {
            let is_there = |sighting: &&Sighting| middle.dot(&sighting.direction) >= SECTOR_COSINE;
            let mut rays: Vec<u32> = alone().filter(is_there).map(|sighting| sighting.ray).collect();
            let both = sightings.iter().filter(is_there).count() - rays.len();
            let claimed = rays.iter().filter(|&&ray| self.association.claims(self.labels[1 - from], ray)).count();
            let share = |count: usize| count as f64 / rays.len() as f64;
            if rays.len() >= LEAST_ALONE && share(both) <= MOST_BOTH && share(claimed) >= CLAIMED_SHARE {
                rays.sort_unstable();
                swaps.push(Swap { from, rays });
            }
        }
        if swaps.len() > 1 {
            let mut rays: Vec<u32> = swaps.iter().flat_map(|swap| &swap.rays).copied().collect();
            rays.sort_unstable();
            rays.dedup();
            swaps.push(Swap { from, rays });
        }
        swaps
    }

    fn sightings(&self, of: usize) -> Vec<Sighting> {
        let scene = self.association.scene;
        let of_other = self.labels[1 - of].images(scene);
        let middle = (self.labels[0].estimate.point + self.labels[1].estimate.point) * 0.5;
        let sighting = |&ray: &u32| Sighting {
            ray,
            direction: direction_to(scene, ray, &middle),
            shows_both: of_other.binary_search(&scene.rays.image[ray as usize]).is_ok(),
        };
        self.labels[of].voters.iter().map(sighting).collect()
    }

    /// What is explained if the two have some votes, or one of them all, with what fits then of what nobody has, some other
    /// labels estimated with the two.
    fn explain(&self, mut voters: [Vec<u32>; 2], companions: &[&Label]) -> Option<Explanation> {
        let &Association { scene, noise, ref index, .. } = self.association;
        let limits = Limits { gate_sigmas: index.gate_sigmas(), min_votes: self.model.settings.min_votes as usize };
        let gatherings = if companions.is_empty() { GATHERINGS.0 } else { GATHERINGS.1 };
        let is_there = [0, 1].map(|side| !voters[side].is_empty());
        let mut points = self.labels.map(|label| label.estimate.point);
        let mut gathering = 0;
        loop {
            let pair = [0, 1].map(|side| Start { voters: &voters[side], weights: &[], point: points[side] });
            let others = companions.iter().map(|label| Start {
                voters: &label.voters,
                weights: &label.weights,
                point: label.estimate.point,
            });
            let solution =
                Joint::new(scene, noise, pair.into_iter().chain(others), Care::Rough).solve_within(&limits)?;
            points = [0, 1].map(|side| solution.estimates[side].point);
            voters = [0, 1].map(|side| {
                let own = solution.votes().iter().filter(|(label, _)| *label == side);
                own.map(|(_, ray)| *ray).collect()
            });
            if (0..2).any(|side| is_there[side] && voters[side].len() < limits.min_votes) {
                return None;
            }
            if gathering == gatherings {
                let gain = limits.gate_sigmas.powi(2) * solution.votes().len() as f64 - solution.square();
                return Some(Explanation { voters, points, gain });
            }
            self.gather(&mut voters, &points);
            gathering += 1;
        }
    }

    /// Give the two what nobody has in their gates, one an image, what is nearest first.
    fn gather(&self, voters: &mut [Vec<u32>; 2], points: &[Vector3<f64>; 2]) {
        let own: FxHashSet<u32> = self.labels.iter().flat_map(|label| &label.voters).copied().collect();
        let mut given: FxHashSet<u32> = voters.iter().flatten().copied().collect();
        let image = |ray: u32| self.association.scene.rays.image[ray as usize];
        let mut shown: FxHashSet<(usize, u32)> =
            (0..).zip(&*voters).flat_map(|(side, voters)| voters.iter().map(move |&ray| (side, image(ray)))).collect();
        let mut free = Vec::new();
        for (side, point) in points.iter().enumerate().filter(|(side, _)| !voters[*side].is_empty()) {
            let hits = self.association.hits(point, self.labels[side].class).into_iter();
            let is_free = |ray: u32| !self.is_taken[ray as usize] || own.contains(&ray);
            free.extend(hits.filter(|hit| is_free(hit.ray)).map(|hit| (hit.chi2, hit.ray, side)));
        }
        free.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        for (_, ray, side) in free {
            if !given.contains(&ray) && shown.insert((side, image(ray))) {
                given.insert(ray);
                voters[side].push(ray);
            }
        }
    }

    /// One of the two as it is explained; it is to be seen from where it has votes now.
    fn label(&self, side: usize, explanation: &Explanation) -> Option<Label> {
        let &Association { scene, noise, ref index, .. } = self.association;
        let point = explanation.points[side];
        let found = from_voters(scene, noise, index.gate_sigmas(), explanation.voters[side].clone(), point)?;
        let is_unseen = |direction: &&Vector3<f64>| {
            found.voters.iter().all(|&ray| direction.dot(&direction_to(scene, ray, &point)) < SECTOR_COSINE)
        };
        let unseen_from = self.labels[side].unseen_from.iter().filter(is_unseen).copied().collect();
        Some(Label { unseen_from, ..found })
    }
}
