//! Errors that the images of a pass share: they drift along the drive.
//!
//! A voter's residual is `r = J (X - X_0) + J b + J [X - C]_x w + e`: e is its own error (detection, and the part of the pose
//! error that each image has for itself); b and w are errors of position and rotation that change slowly along the drive,
//! an Ornstein-Uhlenbeck process: two that are d apart have the correlation `exp(-d / DRIFT_LENGTH_M)`. A drive is cut
//! into short legs of one b and w each, and these are marginalised leg after leg (Schur complement), so that a hundred
//! images before a red light count as one look from there, not as a hundred.

use nalgebra::{Cholesky, Const, Matrix3, SMatrix, SVector, Vector2, Vector3};

use super::noise::Noise;
use super::scene::Scene;

pub(super) type Matrix6 = SMatrix<f64, 6, 6>;
pub(super) type Vector6 = SVector<f64, 6>;
type Matrix3x6 = SMatrix<f64, 3, 6>;

/// Distance over which drifting errors forget 63 % of themselves, m.
pub const DRIFT_LENGTH_M: f64 = 100.0;
/// Drifting errors are one within this distance, m.
pub const LEG_M: f64 = 10.0;

/// What the voters of one pass say about a point: information, gradient, and the terms of their likelihood.
#[derive(Debug, Clone, Copy)]
pub struct PassTerms {
    /// Information about the point, 1/m².
    pub information: Matrix3<f64>,
    /// Gradient of half the squared residuals, 1/m.
    pub gradient: Vector3<f64>,
    /// Squared residuals in sigmas, shared errors taken out.
    pub square: f64,
    /// Logarithm of the determinant of the residuals' covariance.
    pub log_determinant: f64,
}

/// One voter's residual at a point, with its derivatives.
#[derive(Debug, Clone)]
pub struct Look {
    /// Residual, px.
    pub residual: [f64; 2],
    /// By the point.
    pub by_point: [Vector3<f64>; 2],
    /// By the errors of the position (m) and the rotation (rad, in the world) that the pass shares.
    pub by_pose: [Vector6; 2],
    /// Standard deviations of these errors.
    pub drift_sigma: Vector6,
    /// Variance of its own error, px².
    pub variance: f64,
    /// How far its pass had driven, m.
    pub driven_m: f64,
}

impl Look {
    /// The look of a ray at a point; nothing if the point is behind it.
    #[must_use]
    pub fn of(scene: &Scene, noise: &Noise, ray: u32, point: &Vector3<f64>) -> Option<Self> {
        let seen = scene.ray(ray);
        let (residual, rows) = seen.linearize(point)?;
        let (p, r) = noise.shared(scene.view(ray));
        let away = point - seen.center;
        let by_point = rows.map(|row| row.transpose());
        let by_pose = by_point.map(|column| {
            let turned = away.cross(&column);
            Vector6::new(column.x, column.y, column.z, turned.x, turned.y, turned.z)
        });
        let variance = noise.own(scene, ray).variance(seen.project(point).z);
        let drift_sigma = Vector6::new(p, p, p, r, r, r);
        Some(Self { residual, by_point, by_pose, drift_sigma, variance, driven_m: scene.view(ray).driven_m })
    }
}

/// What the looks of one pass at a point say, their drift taken out.
pub struct Drive<'a> {
    /// The normal equations of the point.
    pub terms: PassTerms,
    /// Information about the point if the drift were known, 1/m².
    pub alone: Matrix3<f64>,
    legs: Vec<Leg<'a>>,
}

/// Looks that share one drift.
struct Leg<'a> {
    looks: &'a [Look],
    /// Information about its drift from its looks, those before, and its tie to the next leg.
    of_drift: Cholesky<f64, Const<6>>,
    gradient: Vector6,
    /// How much a unit of the next leg's drift pulls at this one's.
    tie: f64,
}

impl<'a> Drive<'a> {
    /// Go along the looks of a pass, in their order; nothing if their numbers overflow.
    #[must_use]
    pub fn along(looks: &'a [Look], weights: &[f64]) -> Option<Self> {
        let mut terms =
            PassTerms { information: Matrix3::zeros(), gradient: Vector3::zeros(), square: 0.0, log_determinant: 0.0 };
        let mut alone = Matrix3::zeros();
        // The prior of the first leg: drifts are counted in their own sigmas.
        let (mut of_drift, mut gradient, mut cross) = (Matrix6::identity(), Vector6::zeros(), Matrix3x6::zeros());
        let mut legs: Vec<Leg<'a>> = Vec::new();
        let mut rest = looks;
        while !rest.is_empty() {
            let (here, next) = rest.split_at(leg_length(rest));
            let done = looks.len() - rest.len();
            for (look, robust_weight) in here.iter().zip(&weights[done..]) {
                let weight = robust_weight / look.variance;
                terms.log_determinant += 2.0 * look.variance.ln();
                for i in 0..2 {
                    let (r, column) = (look.residual[i], look.by_point[i]);
                    let shared = look.by_pose[i].component_mul(&look.drift_sigma);
                    alone += column * column.transpose() * weight;
                    terms.gradient += column * (r * weight);
                    of_drift += shared * shared.transpose() * weight;
                    gradient += shared * (r * weight);
                    cross += column * shared.transpose() * weight;
                    terms.square += r * r * weight;
                }
            }
            // The next leg's drift is `keep` times this one's, and something new of variance `1 - keep²`.
            let keep =
                next.first().map_or(0.0, |next| (-(next.driven_m - here[0].driven_m).abs() / DRIFT_LENGTH_M).exp());
            let stiffness = 1.0 / (1.0 - keep * keep);
            let tie = keep * stiffness;
            let tied = (of_drift + Matrix6::identity() * (keep * tie)).cholesky()?;
            let by_gradient = tied.solve(&gradient);
            let by_cross = tied.solve(&cross.transpose()).transpose();
            terms.information -= cross * by_cross.transpose();
            terms.gradient -= cross * by_gradient;
            terms.square -= gradient.dot(&by_gradient);
            terms.log_determinant +=
                2.0 * tied.l_dirty().diagonal().iter().map(|d| d.ln()).sum::<f64>() - 6.0 * stiffness.ln();
            of_drift = Matrix6::identity() * stiffness - tied.inverse() * (tie * tie);
            legs.push(Leg { looks: here, of_drift: tied, gradient, tie });
            (gradient, cross) = (by_gradient * tie, by_cross * tie);
            rest = next;
        }
        terms.information += alone;
        Some(Self { terms, alone, legs })
    }

    /// Residuals, px, after the most probable drift is taken out, in the order of the looks.
    #[must_use]
    pub fn left(&self) -> Vec<Vector2<f64>> {
        let mut left = Vec::new();
        let mut drift_of_next = Vector6::zeros();
        for leg in self.legs.iter().rev() {
            let drift = leg.of_drift.solve(&(drift_of_next * leg.tie - leg.gradient));
            let of_look = |look: &Look| {
                let pose = drift.component_mul(&look.drift_sigma);
                Vector2::from([0, 1].map(|i| look.residual[i] + look.by_pose[i].dot(&pose)))
            };
            left.extend(leg.looks.iter().rev().map(of_look));
            drift_of_next = drift;
        }
        left.reverse();
        left
    }
}

/// How many looks, from the first one on, share one drift.
fn leg_length(looks: &[Look]) -> usize {
    let is_far = |look: &Look| (look.driven_m - looks[0].driven_m).abs() > LEG_M;
    looks.iter().position(is_far).unwrap_or(looks.len())
}
