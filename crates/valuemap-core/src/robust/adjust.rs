//! Adjustment: the labels of one place are estimated together ([`Joint`]), without the votes that disagree.

use std::hash::{Hash, Hasher};

use rayon::prelude::*;
use rustc_hash::FxHasher;

use super::estimate::{Care, Joint};
use super::label::{Label, by_place, fingerprint, fitting, side_of};
use super::noise::Noise;
use super::scene::Scene;
use super::settle::first_voter;

/// Labels within this distance of the one with the most votes are estimated with it, m.
const PLACE_M: f64 = 25.0;
/// Labels that are estimated together, at most: the cost grows with the square of their number.
const MOST_LABELS: usize = 12;
/// Rounds of leaving out votes, at most.
const MAX_TRIMS: usize = 4;

/// Estimate all labels anew, place by place; those that keep fewer than `min_votes` are dropped.
#[must_use]
pub fn adjust(
    scene: &Scene,
    noise: &Noise,
    gate_sigmas: f64,
    min_votes: usize,
    labels: &[Label],
    care: Care,
) -> Vec<Label> {
    let of_place = |place: &Vec<usize>| {
        let place: Vec<Label> = place.iter().map(|&i| labels[i].clone()).collect();
        let votes = votes_of(&place);
        if care == Care::Rough && place.iter().all(|label| label.revision.place == votes) {
            return place;
        }
        adjust_place(scene, noise, gate_sigmas, min_votes, place, care)
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
    care: Care,
) -> Vec<Label> {
    let mut together = place.clone();
    for _ in 0..MAX_TRIMS {
        match adjusted(scene, noise, gate_sigmas, &mut together, care) {
            None if place.len() == 1 => return Vec::new(),
            None => {
                let alone = |label| adjust_place(scene, noise, gate_sigmas, min_votes, vec![label], care);
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
fn adjusted(scene: &Scene, noise: &Noise, gate_sigmas: f64, labels: &mut [Label], care: Care) -> Option<bool> {
    let starts = labels.iter().map(|label| (label.voters.as_slice(), label.estimate.point));
    let solution = Joint::new(scene, noise, starts, care).solve()?;
    let (left, refused) = fitting(&solution.own_chi2(), gate_sigmas);
    let is_done = refused.is_empty();
    let elsewhere = if is_done { solution.elsewhere() } else { vec![Vec::new(); labels.len()] };
    let mut voters = vec![Vec::new(); labels.len()];
    for (label, ray) in left {
        voters[label].push(ray);
    }
    for (((label, estimate), elsewhere), voters) in labels.iter_mut().zip(solution.estimates).zip(elsewhere).zip(voters)
    {
        label.side = side_of(scene, &voters, &estimate.point);
        (label.estimate, label.elsewhere, label.voters) = (estimate, elsewhere, voters);
    }
    for (label, ray) in refused {
        labels[label].refused.push(ray);
    }
    Some(is_done)
}
