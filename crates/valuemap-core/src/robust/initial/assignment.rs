//! Assignment in one image: which of its detections shows which of the labels that claim it.
//!
//! All labels in an image are off by its pose error together. With that error taken out, residuals tell two heads on one pole
//! apart even where the error is as large as their distance. Among labels and detections that could go together, the assignment
//! with the least sum of costs wins (joint compatibility; the costs are those of maximum likelihood).

use nalgebra::{Matrix2, SMatrix};
use pathfinding::prelude::{Matrix, kuhn_munkres_min};
use rustc_hash::FxHashSet;

use super::label::Label;
use crate::robust::noise::Noise;
use crate::robust::noise::drift::Look;
use crate::robust::noise::huber::huber_weight;
use crate::robust::noise::poses::{Belief, PoseError};
use crate::robust::scene::Scene;
use crate::robust::search::assign::GAIN_UNIT;

/// Times that the assignment of an image is made anew, with the pose error from the last one. It bounds the work: they end where the assignment stays the same,
/// and others may go back and forth.
const ROUNDS: usize = 3;

/// A detection that a label may have.
#[derive(Debug, Clone, Copy, Default)]
pub struct Claim {
    /// The segment of the drive that the image was taken on.
    pub(super) segment: u32,
    pub(super) image: u32,
    /// The label's number.
    pub(super) label: u32,
    pub(super) ray: u32,
    /// Squared residual over its variance, pose error and all.
    pub(super) chi2: f64,
    pub(super) is_vote: bool,
}

/// A claim as seen from its label: residual with derivatives, and the covariance of all but the pose error, px².
pub(super) struct Case<'a> {
    pub(super) claim: &'a Claim,
    pub(super) look: Look,
    own: Matrix2<f64>,
    /// Variance of the detection, each axis, px².
    detection_px2: f64,
}

impl<'a> Case<'a> {
    pub(super) fn of(scene: &Scene, noise: &Noise, label: &Label, claim: &'a Claim) -> Option<Self> {
        let estimate = label.elsewhere(scene.view(claim.ray));
        let look = Look::of(scene, noise, claim.ray, claim.label as usize, &estimate.point)?;
        let by_point = SMatrix::<f64, 2, 3>::from_rows(&[look.by_point[0].transpose(), look.by_point[1].transpose()]);
        let of_label = by_point * estimate.covariance * by_point.transpose();
        let detection_px2 = noise.detection_px2(scene, claim.ray);
        Some(Self { claim, look, own: Matrix2::identity() * detection_px2 + of_label, detection_px2 })
    }

    /// How well it fits where the pose error is about as said.
    fn cost(&self, pose: &PoseError) -> f64 {
        let (residual, covariance) = pose.expected(&self.look, &self.own);
        let chi2 = covariance.try_inverse().map_or(f64::INFINITY, |inverse| residual.dot(&(inverse * residual)));
        // Narrow likelihoods are high: a label of which little is known must not win because it forbids nothing.
        let widening = (covariance - self.own + Matrix2::identity() * self.detection_px2).determinant();
        chi2 + (covariance.determinant() / widening).ln()
    }
}

/// What the votes of one image say about the drift of its pass.
pub(super) fn belief_of_votes<'c>(cases: impl Iterator<Item = &'c Case<'c>>) -> Belief {
    let mut belief = Belief::nothing();
    for case in cases.filter(|case| case.claim.is_vote) {
        let of_label_px2 = 0.5 * case.own.trace() - case.detection_px2;
        let robust = huber_weight(case.claim.chi2);
        belief.add(&Belief::of_vote(&case.look, (case.look.variance + of_label_px2) / robust));
    }
    belief
}

/// What became of a claim.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fit {
    /// Squared residual, and how much wider its distribution is than that of a label known exactly.
    pub(super) cost: f64,
    pub(super) assigned: bool,
}

/// Judge the claims of one image, whose pose error is about known.
pub(super) fn decide(cases: &[Case<'_>], limit: f64, pose: &PoseError) -> Vec<Fit> {
    let mut costs: Vec<f64> = cases.iter().map(|case| case.cost(pose)).collect();
    let contested: Vec<usize> = (0..cases.len()).filter(|&i| (0..cases.len()).any(|j| shares(cases, i, j))).collect();
    if contested.is_empty() {
        return costs.into_iter().map(|cost| Fit { cost, assigned: cost < limit }).collect();
    }
    let mut assigned = assign(cases, &costs, limit);
    for _ in 1..ROUNDS {
        // The pose error after the first of the assigned claims, after two, and so on: what all share that are independent of these.
        let mut after = vec![*pose];
        for &j in &assigned {
            after.push(after[after.len() - 1].after(&cases[j].look, &cases[j].own));
        }
        for &i in &contested {
            let case = &cases[i];
            let is_independent = |j: usize| {
                let other = cases[j].claim;
                other.label != case.claim.label && other.ray != case.claim.ray
            };
            let first = assigned.iter().position(|&j| !is_independent(j)).unwrap_or(assigned.len());
            let rest = assigned[first..].iter().filter(|&&j| is_independent(j));
            let known = rest.fold(after[first], |pose, &j| pose.after(&cases[j].look, &cases[j].own));
            costs[i] = case.cost(&known);
        }
        let again = assign(cases, &costs, limit);
        if again == assigned {
            break;
        }
        assigned = again;
    }
    (0..).zip(costs).map(|(i, cost)| Fit { cost, assigned: assigned.binary_search(&i).is_ok() }).collect()
}

/// Take the detections that a better label claims as well from labels that are overruled.
pub(super) fn overrule(cases: &[Case<'_>], fits: &mut [Fit], overruled: &FxHashSet<(u32, u32)>, limit: f64) {
    let is_overruled = |j: usize, fits: &[Fit]| {
        let claim = cases[j].claim;
        let mut rivals = (0..cases.len()).filter(|&i| fits[i].cost < limit && cases[i].claim.ray == claim.ray);
        rivals.any(|i| overruled.contains(&(cases[i].claim.label, claim.label)))
    };
    let out: Vec<usize> = (0..cases.len()).filter(|&j| fits[j].cost < limit && is_overruled(j, fits)).collect();
    if out.is_empty() {
        return;
    }
    let mut costs: Vec<f64> = fits.iter().map(|fit| fit.cost).collect();
    for &j in &out {
        costs[j] = f64::INFINITY;
    }
    let assigned = assign(cases, &costs, limit);
    for (i, fit) in fits.iter_mut().enumerate() {
        fit.assigned = assigned.binary_search(&i).is_ok();
    }
}

/// The claims of one image that fit, by label.
pub(super) fn open<'c>(cases: &'c [Case<'c>], fits: &'c [Fit], limit: f64) -> impl Iterator<Item = &'c Claim> + Clone {
    cases.iter().zip(fits).filter(move |(_, fit)| fit.cost < limit).map(|(case, _)| case.claim)
}

/// The claims of one image that are assigned, by label.
pub(super) fn assigned<'c>(cases: &'c [Case<'c>], fits: &'c [Fit]) -> impl Iterator<Item = &'c Claim> {
    cases.iter().zip(fits).filter(|(_, fit)| fit.assigned).map(|(case, _)| case.claim)
}

/// The claims that are assigned, ascending: the assignment with the least sum of costs, where a detection without a label costs as
/// much as one at the gate. Claims that have nothing to do with each other are assigned for themselves.
fn assign(cases: &[Case<'_>], costs: &[f64], limit: f64) -> Vec<usize> {
    let mut open: Vec<usize> = (0..cases.len()).filter(|&i| costs[i] < limit).collect();
    let mut assigned = Vec::with_capacity(open.len());
    while let Some(first) = open.pop() {
        let mut tied = vec![first];
        let mut next = 0;
        while let Some(&tie) = tied.get(next) {
            open.retain(|&i| {
                let is_tied = shares(cases, tie, i);
                if is_tied {
                    tied.push(i);
                }
                !is_tied
            });
            next += 1;
        }
        let is_one = |of: fn(&Claim) -> u32| tied.iter().all(|&i| of(cases[i].claim) == of(cases[first].claim));
        if is_one(|claim| claim.label) || is_one(|claim| claim.ray) {
            assigned.extend(tied.into_iter().min_by(|&i, &j| costs[i].total_cmp(&costs[j]).then(i.cmp(&j))));
        } else {
            assigned.extend(assign_tied(cases, costs, limit, tied));
        }
    }
    assigned.sort_unstable();
    assigned
}

/// The assignment of claims of several labels for several detections.
fn assign_tied(cases: &[Case<'_>], costs: &[f64], limit: f64, open: Vec<usize>) -> Vec<usize> {
    let mut rays: Vec<u32> = open.iter().map(|&i| cases[i].claim.ray).collect();
    rays.sort_unstable();
    rays.dedup();
    let mut labels: Vec<u32> = open.iter().map(|&i| cases[i].claim.label).collect();
    labels.sort_unstable();
    labels.dedup();
    let none = (limit / GAIN_UNIT) as i64;
    // One more column for each detection: it shows no label.
    let mut table = Matrix::new(rays.len(), labels.len() + rays.len(), 2 * none);
    for row in 0..rays.len() {
        for column in labels.len()..labels.len() + rays.len() {
            table[(row, column)] = none;
        }
    }
    for &i in &open {
        let at = (rays.binary_search(&cases[i].claim.ray), labels.binary_search(&cases[i].claim.label));
        if let (Ok(row), Ok(column)) = at {
            table[(row, column)] = (costs[i] / GAIN_UNIT) as i64;
        }
    }
    let (_, columns) = kuhn_munkres_min(&table);
    let is_assigned = |i: &usize| {
        let at = (rays.binary_search(&cases[*i].claim.ray), labels.binary_search(&cases[*i].claim.label));
        matches!(at, (Ok(row), Ok(column)) if columns[row] == column)
    };
    open.into_iter().filter(is_assigned).collect()
}

/// Whether two claims are for the same label or the same detection.
fn shares(cases: &[Case<'_>], i: usize, j: usize) -> bool {
    i != j && (cases[i].claim.label == cases[j].claim.label || cases[i].claim.ray == cases[j].claim.ray)
}
