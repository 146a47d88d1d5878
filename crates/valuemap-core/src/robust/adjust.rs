//! Adjustment: the labels of one place are estimated together ([`Joint`]), without the votes that disagree.

use std::hash::{Hash, Hasher};

use rayon::prelude::*;
use rustc_hash::FxHasher;

use super::estimate::Joint;
use super::label::{EXACT_M, Label, by_place, fingerprint, fitting, side_of};
use super::noise::Noise;
use super::scene::Scene;
use super::settle::first_voter;

/// Labels within this distance of the one with the most votes are estimated with it, m.
const PLACE_M: f64 = 25.0;
/// Labels that are estimated together, at most: the cost grows with the square of their number.
const MOST_LABELS: usize = 12;
/// Rounds of leaving out votes, at most.
const MAX_TRIMS: usize = 4;

/// Estimate all labels anew, place by place, to a tolerance; those that keep fewer than `min_votes` are dropped.
#[must_use]
pub fn adjust(
    scene: &Scene,
    noise: &Noise,
    gate_sigmas: f64,
    min_votes: usize,
    labels: &[Label],
    tolerance_m: f64,
) -> Vec<Label> {
    let of_place = |place: &Vec<usize>| {
        let place: Vec<Label> = place.iter().map(|&i| labels[i].clone()).collect();
        let votes = votes_of(&place);
        if tolerance_m > EXACT_M && place.iter().all(|label| label.revision.place == votes) {
            return place;
        }
        adjust_place(scene, noise, gate_sigmas, min_votes, place, tolerance_m)
    };
    let mut labels: Vec<Label> = places(labels).par_iter().flat_map_iter(of_place).collect();
    labels.sort_by_key(first_voter);
    labels
}

/// The labels around those with the most votes, each label in one place.
fn places(labels: &[Label]) -> Vec<Vec<usize>> {
    let tree = by_place(labels);
    let mut order: Vec<usize> = (0..labels.len()).collect();
    order.sort_by_key(|&i| (std::cmp::Reverse(labels[i].voters.len()), i));
    let mut taken = vec![false; labels.len()];
    let mut places = Vec::new();
    for middle in order {
        if taken[middle] {
            continue;
        }
        let near = tree.nearest_neighbor_iter_with_distance_2(labels[middle].estimate.point.into());
        let near = near.take_while(|(_, distance2)| *distance2 <= PLACE_M * PLACE_M).map(|(near, _)| near.data);
        let mut place: Vec<usize> = near.filter(|&i| !taken[i]).take(MOST_LABELS).collect();
        place.sort_unstable();
        for &i in &place {
            taken[i] = true;
        }
        places.push(place);
    }
    places
}

/// Labels that cannot be estimated together are estimated one by one.
fn adjust_place(
    scene: &Scene,
    noise: &Noise,
    gate_sigmas: f64,
    min_votes: usize,
    place: Vec<Label>,
    tolerance_m: f64,
) -> Vec<Label> {
    let mut together = place.clone();
    for _ in 0..MAX_TRIMS {
        match adjusted(scene, noise, gate_sigmas, &mut together, tolerance_m) {
            None if place.len() == 1 => return Vec::new(),
            None => {
                let alone = |label| adjust_place(scene, noise, gate_sigmas, min_votes, vec![label], tolerance_m);
                return place.into_iter().flat_map(alone).collect();
            }
            Some(is_done) => {
                together.retain(|label| label.voters.len() >= min_votes);
                if is_done || together.is_empty() {
                    break;
                }
            }
        }
    }
    let votes = votes_of(&together);
    for label in &mut together {
        label.revise();
        label.revision.place = votes;
    }
    together
}

/// A fingerprint of the votes of some labels.
fn votes_of(labels: &[Label]) -> u64 {
    let mut hasher = FxHasher::default();
    for label in labels {
        fingerprint(&label.voters).hash(&mut hasher);
    }
    hasher.finish()
}

/// Estimate labels together and leave votes out that do not fit; whether there were none.
fn adjusted(scene: &Scene, noise: &Noise, gate_sigmas: f64, labels: &mut [Label], tolerance_m: f64) -> Option<bool> {
    let starts = labels.iter().map(|label| (label.voters.as_slice(), label.estimate.point));
    let solution = Joint::new(scene, noise, starts, tolerance_m).solve()?;
    let votes = solution.own_chi2();
    let left = fitting(&votes, gate_sigmas);
    let is_done = left.len() == votes.len();
    let elsewhere = if is_done { solution.elsewhere() } else { vec![Vec::new(); labels.len()] };
    let mut voters = vec![Vec::new(); labels.len()];
    for (label, ray) in left {
        voters[label].push(ray);
    }
    for (((label, estimate), elsewhere), voters) in labels.iter_mut().zip(solution.estimates).zip(elsewhere).zip(voters)
    {
        label.side = side_of(scene, &voters, &estimate.point);
        label.refused.extend(label.voters.iter().filter(|ray| !voters.contains(ray)));
        (label.estimate, label.elsewhere, label.voters) = (estimate, elsewhere, voters);
    }
    Some(is_done)
}
