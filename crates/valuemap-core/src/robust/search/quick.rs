//! Quick estimate of a position: least squares over its votes as if every image had its pose error for itself.
//!
//! It is a few times cheaper than [`estimate`](crate::robust::energy::estimate), gives no covariance and is a little less exact: good enough to
//! gather votes around a point.

use nalgebra::{Matrix3, Vector3};

use crate::robust::energy::estimate::{LONGEST_STEP_M, shares_of_step};
use crate::robust::noise::Spread;
use crate::robust::noise::huber::huber_weight;
use crate::robust::noise::index::chi2;
use crate::robust::scene::Scene;

/// Good enough while votes may still change, m. At 40 m it is a quarter of a pixel at a focal length of 1,000 px.
const ROUGH_M: f64 = 1e-2;
/// Steps, at most. It bounds the work: what is kept is estimated anew, and with drift.
const MAX_ITERATIONS: usize = 8;

/// Estimate a position from its voters, starting nearby, to a few millimetres.
///
/// Nothing if it ends up behind a voter, or the voters do not fix it.
#[must_use]
pub fn quick_estimate(scene: &Scene, spreads: &[Spread], voters: &[u32], start: Vector3<f64>) -> Option<Vector3<f64>> {
    let mut point = start;
    for _ in 0..MAX_ITERATIONS {
        let (mut information, mut gradient) = (Matrix3::zeros(), Vector3::zeros());
        for &voter in voters {
            let (ray, spread) = (scene.ray(voter), &spreads[voter as usize]);
            let projected = ray.project(&point);
            let (residual, rows) = ray.linearize_beside(&projected, spread.share_of_position(projected.z))?;
            let robust = huber_weight(chi2(&projected, spread));
            let weight = robust / spread.variance(projected.z);
            for (r, row) in residual.into_iter().zip(rows) {
                let column = row.transpose() * weight;
                information += column * row;
                gradient += column * r;
            }
        }
        let step = -information.cholesky()?.solve(&gradient);
        let length = step.norm();
        let step = step * (LONGEST_STEP_M / length).min(1.0);
        // As far as no voter has it behind.
        let is_in_front = |at: &Vector3<f64>| voters.iter().all(|&voter| scene.ray(voter).project(at).z > 0.0);
        point = shares_of_step().map(|share| point + step * share).find(is_in_front)?;
        if length < ROUGH_M {
            break;
        }
    }
    point.iter().all(|number| number.is_finite()).then_some(point)
}
