//! Contested votes: an image shows only one of two neighbours, and its detection might be of either.
//!
//! Pose errors hide which of the two it is, and decide it alike for all images from there, so no covariance knows of it. The
//! position is estimated once more without the contested votes. If the two positions differ by more than their covariances allow
//! (Hausman, "Specification Tests in Econometrics", 1978), their difference widens the covariance.

use nalgebra::Vector3;
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use crate::robust::energy::estimate::{Estimate, Solution};
use crate::robust::energy::places::ByPlace;
use crate::robust::energy::{Object, by_place};
use crate::robust::model::Model;
use crate::robust::noise::index::chi2_in_gate;
use crate::robust::search::rearrange::near_m;

/// Squared distance in sigmas up to which the positions with and without contested votes agree: the 95 % quantile of chi²
/// with 3 degrees of freedom.
const AGREEMENT_CHI2: f64 = 7.8;
/// Where the contested votes tell next to nothing, the difference of the covariances is at least this share of them. So they widen nothing there unless the
/// positions differ by more than 0.28 sigmas.
const LEAST_DIFFERENCE: f64 = 1e-2;

/// Labels that might have each other's votes.
pub struct Contest<'a> {
    model: &'a Model<'a>,
    labels: &'a [Object],
    tree: ByPlace,
    /// The images that show each label.
    shown_in: Vec<FxHashSet<u32>>,
}

impl<'a> Contest<'a> {
    /// Begin with all labels of a scene.
    #[must_use]
    pub fn new(model: &'a Model<'a>, labels: &'a [Object]) -> Self {
        let images = |label: &Object| label.votes.iter().map(|&ray| model.scene.image_of(ray)).collect();
        let shown_in = labels.par_iter().map(images).collect();
        Self { model, labels, tree: by_place(labels), shown_in }
    }

    /// For each vote of a solution whether a neighbor that its image does not show might have it.
    #[must_use]
    pub fn contested(&self, solution: &Solution<'_>) -> Vec<bool> {
        let reach_m = near_m(self.model);
        let neighbors = |estimate: &Estimate| -> Vec<usize> {
            let near = self.tree.locate_within_distance(estimate.point.into(), reach_m * reach_m);
            near.map(|near| near.data).collect()
        };
        let near: Vec<Vec<usize>> = solution.estimates.iter().map(neighbors).collect();
        solution.votes().iter().map(|&(label, ray)| near[label].iter().any(|&i| self.might_have(i, ray))).collect()
    }

    /// Never the label that has it: its images are those that show it.
    fn might_have(&self, neighbor: usize, ray: u32) -> bool {
        let (scene, gate_sigmas) = (self.model.scene, self.model.settings.gate_sigmas);
        let (seen, spread) = (scene.ray(ray), &self.model.spreads[ray as usize]);
        self.model.confusions.may_be(self.labels[neighbor].class, scene.class_of(ray))
            && !self.shown_in[neighbor].contains(&scene.image_of(ray))
            && chi2_in_gate(seen, &self.labels[neighbor].fit.point, spread, gate_sigmas).is_some()
    }
}

/// An estimate with what contested votes may have done to it; `sure` rests on the other votes alone.
///
/// The difference of two estimates, one of which rests on a part of what the other rests on, has the difference of their
/// covariances (Hausman, "Specification Tests in Econometrics", Econometrica 46, 1978).
#[must_use]
pub fn widened(estimate: &Estimate, sure: &Estimate) -> Estimate {
    let apart: Vector3<f64> = sure.point - estimate.point;
    let difference = sure.covariance - estimate.covariance * (1.0 - LEAST_DIFFERENCE);
    let chi2 = difference.cholesky().map(|cholesky| apart.dot(&cholesky.solve(&apart)));
    let widens = if chi2.is_some_and(|chi2| chi2 > AGREEMENT_CHI2) { 1.0 } else { 0.0 };
    Estimate { covariance: estimate.covariance + apart * apart.transpose() * widens, ..*estimate }
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix3;

    use super::*;

    fn at(x_m: f64, variance_m2: f64) -> Estimate {
        Estimate { point: Vector3::new(x_m, 0.0, 0.0), covariance: Matrix3::identity() * variance_m2 }
    }

    #[test]
    fn votes_that_agree_change_nothing() {
        assert_eq!(widened(&at(0.0, 0.01), &at(0.2, 0.02)), at(0.0, 0.01));
    }

    #[test]
    fn votes_that_disagree_widen_the_covariance_by_how_much() {
        let found = widened(&at(0.0, 0.01), &at(0.5, 0.02)).covariance;
        assert!((found - Matrix3::from_diagonal(&Vector3::new(0.26, 0.01, 0.01))).norm() < 1e-12);
    }
}
