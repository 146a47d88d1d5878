//! Two-view triangulation: the least change of two detections that makes their rays meet.
//!
//! An iteration after P. Lindstrom, "Triangulation Made Easy", CVPR 2010, run to convergence. It minimises the sum of
//! the two squared reprojection errors, Eq. (1) of the VALUE paper with two views, at a fraction of the cost of a
//! general solver. Each iteration satisfies the epipolar constraint exactly, so that the errors it ends with are
//! those of a point.

use nalgebra::{Matrix3, Vector2, Vector3};

use crate::ray::Ray;

const MAX_ITERATIONS: usize = 30;
/// A change of the residuals below this fraction of the largest allowed ends the iteration.
const TOLERANCE: f64 = 1e-9;

/// A ray prepared for pairing: `center + s * world_from_residual * (u, v, 1)` projects to the residual (u, v) at depth s.
#[derive(Debug, Clone, Copy)]
pub struct View {
    center: Vector3<f64>,
    world_from_residual: Matrix3<f64>,
    /// Norm of the first two columns: how far a residual of 1 px moves the ray at depth 1.
    per_px: f64,
}

/// The point where two corrected rays meet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Meeting {
    /// The point in the world, m.
    pub point: Vector3<f64>,
    /// Depths along the two virtual axes, m; negative is behind the camera.
    pub depth: [f64; 2],
    /// Squared reprojection errors, px².
    pub squared_error: [f64; 2],
}

impl View {
    /// Nothing for a ray whose projection is degenerate.
    #[must_use]
    pub fn new(ray: &Ray) -> Option<Self> {
        let inverse = ray.residual_from_world.try_inverse()?;
        let per_px = inverse.fixed_columns::<2>(0).norm();
        Some(Self { center: ray.center, world_from_residual: inverse, per_px })
    }
}

/// Whether no point can have both errors below `max_error_px`: cheap, and never wrong when it says so.
///
/// With residuals u in a and v in b, rays meet only if `c + n·u + m·v + u·F v = 0`; so none do where
/// `|c| > e |n| + e |m| + e² |F|`.
#[inline]
#[must_use]
pub fn miss(a: &View, b: &View, max_error_px: f64) -> bool {
    let baseline = b.center - a.center;
    let (columns_a, columns_b) = (&a.world_from_residual, &b.world_from_residual);
    let across_a = baseline.cross(&columns_a.column(2));
    let across_b = baseline.cross(&columns_b.column(2));
    let violation = columns_a.column(2).dot(&across_b);
    let normal_a = [0, 1].map(|i| columns_a.column(i).dot(&across_b));
    let normal_b = [0, 1].map(|i| columns_b.column(i).dot(&across_a));
    let norm = |normal: [f64; 2]| (normal[0] * normal[0] + normal[1] * normal[1]).sqrt();
    let bilinear = max_error_px * baseline.norm() * a.per_px * b.per_px;
    violation.abs() > max_error_px * (norm(normal_a) + norm(normal_b) + bilinear)
}

/// Where the rays of two views meet after the least correction.
///
/// Nothing where both errors cannot be below `max_error_px`, or where the rays are parallel.
#[must_use]
pub fn meet(a: &View, b: &View, max_error_px: f64) -> Option<Meeting> {
    let baseline = b.center - a.center;
    let essential = a.world_from_residual.transpose() * baseline.cross_matrix() * b.world_from_residual;
    let [error_a, error_b] = least_correction(&essential, max_error_px)?;
    let along_a = a.world_from_residual * error_a.push(1.0);
    let along_b = b.world_from_residual * error_b.push(1.0);
    let normal = along_a.cross(&along_b);
    let scale = 1.0 / normal.norm_squared();
    let depth = [baseline.cross(&along_b).dot(&normal) * scale, baseline.cross(&along_a).dot(&normal) * scale];
    if !depth[0].is_finite() || !depth[1].is_finite() {
        return None;
    }
    let point = 0.5 * (a.center + along_a * depth[0] + b.center + along_b * depth[1]);
    Some(Meeting { point, depth, squared_error: [error_a.norm_squared(), error_b.norm_squared()] })
}

/// The residuals `(u, v)` nearest to `(0, 0)` in both views with `(u_a, v_a, 1) E (u_b, v_b, 1)^T = 0`.
fn least_correction(essential: &Matrix3<f64>, max_error_px: f64) -> Option<[Vector2<f64>; 2]> {
    let inner = essential.fixed_view::<2, 2>(0, 0);
    let (to_a, to_b) = (essential.fixed_view::<2, 1>(0, 2), essential.fixed_view::<1, 2>(2, 0).transpose());
    let violation = essential[(2, 2)];
    let limit = max_error_px * max_error_px;
    let mut errors = [Vector2::zeros(); 2];
    for _ in 0..MAX_ITERATIONS {
        // At the least correction each residual lies along the normal of the other's constraint line. Go along the
        // normals at the current residuals as far as the constraint says, a quadratic equation.
        let (normal_a, normal_b) = (to_a + inner * errors[1], to_b + inner.transpose() * errors[0]);
        let curvature = normal_a.dot(&(inner * normal_b));
        let half = 0.5 * (normal_a.dot(&to_a) + normal_b.dot(&to_b));
        let multiplier = violation / (half + (half * half - curvature * violation).sqrt());
        let next = [normal_a * -multiplier, normal_b * -multiplier];
        let change = (next[0] - errors[0]).norm_squared() + (next[1] - errors[1]).norm_squared();
        errors = next;
        if change <= TOLERANCE * TOLERANCE * limit {
            break;
        }
    }
    errors.iter().all(|error| error.norm_squared() < limit).then_some(errors)
}
