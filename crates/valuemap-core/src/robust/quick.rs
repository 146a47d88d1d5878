//! Where an object is, in a hurry: least squares over its voters as if every image had its pose error for itself.
//!
//! A few times cheaper than [`estimate`](super::estimate), without its covariance and a little less exact: good enough
//! to gather voters around.

use nalgebra::{Matrix3, Vector3};

use super::estimate::ROUGH_M;
use super::index::chi2;
use super::noise::Spread;
use super::scene::Scene;

const MAX_ITERATIONS: usize = 8;
/// Residuals beyond this many squared sigmas count less, in proportion to their root (Huber).
const HUBER_CHI2: f64 = 4.0;
/// A longer step is shortened to this, m.
const LONGEST_STEP_M: f64 = 5.0;

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
            let (residual, rows) = ray.linearize_at(&projected)?;
            let robust = (HUBER_CHI2 / chi2(&projected, spread)).sqrt().min(1.0);
            let weight = robust / spread.variance(projected.z);
            for (r, row) in residual.into_iter().zip(rows) {
                let column = row.transpose() * weight;
                information += column * row;
                gradient += column * r;
            }
        }
        let step = -information.cholesky()?.solve(&gradient);
        let length = step.norm();
        point += step * (LONGEST_STEP_M / length).min(1.0);
        if length < ROUGH_M {
            break;
        }
    }
    point.iter().all(|number| number.is_finite()).then_some(point)
}
