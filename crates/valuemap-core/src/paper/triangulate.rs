//! K-view triangulation: the point with the least sum of squared reprojection errors, Eq. (1) of the paper.

use nalgebra::{Matrix3, Vector3};

use crate::ray::Ray;

const MAX_ITERATIONS: usize = 60;
/// A step shorter than this ends the iteration, m. Steps shrink by a factor each time, so the error left is smaller.
const STEP_TOLERANCE_M: f64 = 1e-9;

/// Minimise the summed squared reprojection error over `rays` from `start`, by Levenberg-Marquardt.
///
/// Nothing where `start` is behind one of the cameras. The result is in front of all of them.
pub fn refine<'a>(rays: &(impl Iterator<Item = &'a Ray> + Clone), start: Vector3<f64>) -> Option<Vector3<f64>> {
    let mut point = start;
    let mut damping = 0.0;
    let mut equations = NormalEquations::at(rays.clone(), &point)?;
    for _ in 0..MAX_ITERATIONS {
        let Some(step) = equations.step(damping) else {
            damping = raise(damping);
            continue;
        };
        let candidate = point + step;
        match NormalEquations::at(rays.clone(), &candidate) {
            Some(next) if next.cost <= equations.cost => {
                point = candidate;
                equations = next;
                damping = if damping > 1e-9 { damping * 0.1 } else { 0.0 };
                if step.norm() < STEP_TOLERANCE_M {
                    break;
                }
            }
            // At the bottom, rounding decides whether the cost still falls.
            _ if step.norm() < STEP_TOLERANCE_M => break,
            _ => damping = raise(damping),
        }
    }
    Some(point)
}

/// Covariance of a triangulated point for detections of 1 px standard deviation an axis, in m²: the inverse of
/// the normal equations. Infinite on the diagonal where the rays do not fix the point.
pub fn unit_covariance<'a>(rays: impl Iterator<Item = &'a Ray>, point: &Vector3<f64>) -> Matrix3<f64> {
    NormalEquations::at(rays, point)
        .and_then(|equations| equations.hessian.cholesky())
        .map_or_else(|| Matrix3::from_diagonal_element(f64::INFINITY), |cholesky| cholesky.inverse())
}

fn raise(damping: f64) -> f64 {
    if damping > 0.0 { damping * 10.0 } else { 1e-4 }
}

/// `J^T J`, `J^T r` and `r^T r` of all residuals at a point.
struct NormalEquations {
    hessian: Matrix3<f64>,
    gradient: Vector3<f64>,
    cost: f64,
}

impl NormalEquations {
    /// Nothing where the point is behind one of the cameras.
    fn at<'a>(rays: impl Iterator<Item = &'a Ray>, point: &Vector3<f64>) -> Option<Self> {
        let mut sum = Self { hessian: Matrix3::zeros(), gradient: Vector3::zeros(), cost: 0.0 };
        for ray in rays {
            let (residual, rows) = ray.linearize(point)?;
            for (r, row) in residual.into_iter().zip(rows) {
                let column = row.transpose();
                sum.hessian += column * row;
                sum.gradient += column * r;
                sum.cost += r * r;
            }
        }
        Some(sum)
    }

    /// The step `-(H + damping diag(H))^-1 g`.
    fn step(&self, damping: f64) -> Option<Vector3<f64>> {
        let mut damped = self.hessian;
        for i in 0..3 {
            damped[(i, i)] *= 1.0 + damping;
        }
        damped.cholesky().map(|cholesky| -cholesky.solve(&self.gradient))
    }
}
