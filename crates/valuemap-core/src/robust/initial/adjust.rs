//! Adjustment: the labels of one place are estimated together ([`Joint`]), without the votes that do not fit.
//!
//! Labels of a place share the pose errors of their images, which tells errors of a pass from errors of a label.

use std::hash::{Hash, Hasher};

use rayon::prelude::*;
use rustc_hash::FxHasher;

use super::label::{Label, first_voter, side_of};
use crate::progress::{Halt, Progress};
use crate::robust::energy::estimate::{Care, Joint, Limits, Start};
use crate::robust::energy::places::places;
use crate::robust::model::Model;
use crate::robust::scene::sample::fingerprint;

/// Labels within this distance of the one with the most votes are estimated with it, m. Within 15 m neighbors are missing, and 40 m are as accurate for more
/// work.
pub const PLACE_M: f64 = 25.0;

/// Estimate all labels anew, place by place; those that keep too few votes are dropped.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn adjust(model: &Model<'_>, labels: &[Label], progress: &Progress) -> Result<Vec<Label>, Halt> {
    let of_place = |place: &Vec<usize>| {
        progress.check()?;
        Ok(of_place(model, place.iter().map(|&i| labels[i].clone()).collect()))
    };
    // One at a time: the first ones are the largest.
    let placed: Vec<_> = labels.iter().map(|label| (label.voters.len(), label.estimate.point)).collect();
    let places = places(&placed, PLACE_M);
    let adjusted: Vec<Vec<Label>> = places.par_iter().with_max_len(1).map(of_place).collect::<Result<_, Halt>>()?;
    let mut labels: Vec<Label> = adjusted.into_iter().flatten().collect();
    labels.sort_by_cached_key(first_voter);
    Ok(labels)
}

/// The labels of a place: as they are if their votes are those that they were estimated with.
fn of_place(model: &Model<'_>, place: Vec<Label>) -> Vec<Label> {
    let votes = votes_of(&place);
    if place.iter().all(|label| label.revision.place == votes) {
        return place;
    }
    let mut together = together(model, place);
    let votes = votes_of(&together);
    for label in &mut together {
        label.revise();
        label.revision.place = votes;
    }
    together
}

/// Labels that cannot be estimated together are estimated one by one.
fn together(model: &Model<'_>, place: Vec<Label>) -> Vec<Label> {
    match estimate(model, &place) {
        None if place.len() == 1 => Vec::new(),
        None => place.into_iter().flat_map(|label| together(model, vec![label])).collect(),
        Some(together) => together,
    }
}

/// Estimate labels together and leave votes out that do not fit.
fn estimate(model: &Model<'_>, place: &[Label]) -> Option<Vec<Label>> {
    let starts =
        place.iter().map(|label| Start { voters: &label.voters, weights: &label.weights, point: label.estimate.point });
    let limits = Limits { gate_sigmas: model.settings.gate_sigmas, min_votes: model.settings.min_votes };
    let solution = Joint::new(model.scene, model.noise, starts, Care::Rough).solve_within(&limits)?;
    let mut labels = place.to_vec();
    for ((label, estimate), elsewhere) in labels.iter_mut().zip(&solution.estimates).zip(solution.elsewhere()) {
        (label.estimate, label.elsewhere) = (*estimate, elsewhere);
    }
    for label in &mut labels {
        label.voters.clear();
        label.weights.clear();
    }
    for (&(label, ray), &weight) in solution.votes().iter().zip(solution.weights()) {
        labels[label].voters.push(ray);
        labels[label].weights.push(weight);
    }
    for &(label, ray) in &solution.refused {
        labels[label].refused.push(ray);
    }
    labels.retain(|label| label.voters.len() >= limits.min_votes);
    for label in &mut labels {
        label.side = side_of(model.scene, &label.voters, &label.estimate.point);
    }
    Some(labels)
}

/// A fingerprint of the votes of some labels.
fn votes_of(labels: &[Label]) -> u64 {
    let mut hasher = FxHasher::default();
    for label in labels {
        fingerprint(&label.voters).hash(&mut hasher);
    }
    hasher.finish()
}
