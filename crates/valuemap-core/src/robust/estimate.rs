//! Where an object is, and how sure that is: least squares over its voters, with pose errors that a pass shares.
//!
//! A voter's residual is `r = J (X - X_0) + J b + J [X - C]_x w + e`: e is its own error (detection, and the part of the pose
//! error that each image has for itself), b and w are errors of position and rotation that all voters of a pass share. With
//! Gaussian priors, b and w are marginalised pass by pass (Schur complement), so that a hundred images before a red
//! light count as one look from there, not as a hundred. The inverse of what remains is the covariance.

use nalgebra::{Matrix2, Matrix3, SMatrix, SVector, Vector2, Vector3};

use super::noise::Noise;
use super::scene::Scene;

type Matrix6 = SMatrix<f64, 6, 6>;
type Vector6 = SVector<f64, 6>;
type Matrix3x6 = SMatrix<f64, 3, 6>;

const MAX_ITERATIONS: usize = 20;
/// Freedom left to a residual that the point follows altogether, as a share of its variance.
const LEAST_FREEDOM: f64 = 1e-3;
const LONGEST_STEP_M: f64 = 5.0;
/// Residuals beyond this many sigmas count less, in proportion (Huber).
const HUBER_SIGMAS: f64 = 2.0;

/// A position with its covariance, m².
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Position in the world, m.
    pub point: Vector3<f64>,
    /// Covariance, m².
    pub covariance: Matrix3<f64>,
}

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

/// Estimate a position from its voters, starting nearby, until a step is shorter than the tolerance; `voters` must be
/// ordered by pass.
///
/// Nothing if the point ends up behind a voter, or the voters do not fix it.
#[must_use]
pub fn estimate(
    scene: &Scene,
    noise: &Noise,
    voters: &[u32],
    start: Vector3<f64>,
    tolerance_m: f64,
) -> Option<Estimate> {
    let mut point = start;
    let mut weights = vec![1.0; voters.len()];
    let mut information = Matrix3::zeros();
    for _ in 0..MAX_ITERATIONS {
        let here = Evaluation::at(scene, noise, voters, &weights, &point)?;
        let step = -here.information.cholesky()?.solve(&here.gradient);
        point += step * (LONGEST_STEP_M / step.norm()).min(1.0);
        weights = here.own.iter().map(|chi2| (HUBER_SIGMAS / chi2.sqrt()).min(1.0)).collect();
        information = here.information;
        if step.norm() < tolerance_m {
            break;
        }
    }
    // The last step may have gone behind a voter.
    voters.iter().all(|&ray| scene.ray(ray).project(&point).z > 0.0).then_some(())?;
    Some(Estimate { point, covariance: information.cholesky()?.inverse() })
}

/// Squared residuals of the voters at a point in their own sigmas, after the error that their pass shares is taken out,
/// studentised: a voter that pulls the point towards itself has a small residual, and is expected to.
///
/// `voters` must be ordered by pass. Nothing if the point is behind one of them.
#[must_use]
pub fn own_chi2(scene: &Scene, noise: &Noise, voters: &[u32], point: &Vector3<f64>) -> Option<Vec<f64>> {
    Some(Evaluation::at(scene, noise, voters, &vec![1.0; voters.len()], point)?.own)
}

/// The normal equations of all voters at a point, and how well each fits.
struct Evaluation {
    information: Matrix3<f64>,
    gradient: Vector3<f64>,
    /// See [`own_chi2`].
    own: Vec<f64>,
}

impl Evaluation {
    fn at(scene: &Scene, noise: &Noise, voters: &[u32], weights: &[f64], point: &Vector3<f64>) -> Option<Self> {
        let looks = looks_at(scene, noise, voters, point)?;
        let (mut information, mut gradient) = (Matrix3::zeros(), Vector3::zeros());
        let mut alone = Matrix3::zeros();
        let mut left: Vec<Vector2<f64>> = Vec::with_capacity(voters.len());
        for pass in by_pass(scene, voters) {
            let range = left.len()..left.len() + pass.len();
            let sums = PassSums::of(&looks[range.clone()], &weights[range.clone()]);
            let terms = sums.terms()?;
            information += terms.information;
            gradient += terms.gradient;
            alone += sums.information;
            let shared = -sums.of_shared.cholesky()?.solve(&sums.shared_gradient);
            let of_look =
                |look: &Look| Vector2::from([0, 1].map(|i| look.residual[i] + look.by_shared[i].dot(&shared)));
            left.extend(looks[range].iter().map(of_look));
        }
        let covariance = alone.cholesky()?.inverse();
        let own = looks.iter().zip(weights).zip(&left).map(|((look, weight), left)| {
            let pull = |i: usize, k: usize| weight * look.by_point[i].dot(&(covariance * look.by_point[k]));
            let pulled = Matrix2::new(pull(0, 0), pull(0, 1), pull(1, 0), pull(1, 1));
            let expected = Matrix2::from_diagonal_element(look.variance * (1.0 + LEAST_FREEDOM)) - pulled;
            expected.cholesky().map_or(f64::INFINITY, |cholesky| left.dot(&cholesky.solve(left)))
        });
        let own = own.collect();
        let (by_range, by_range_gradient) = range_terms(scene, voters, point);
        Some(Self { information: information + by_range, gradient: gradient + by_range_gradient, own })
    }
}

/// Information and gradient of measured ranges: each is one more observation of its voter, along the viewing direction.
fn range_terms(scene: &Scene, voters: &[u32], point: &Vector3<f64>) -> (Matrix3<f64>, Vector3<f64>) {
    let mut sum = (Matrix3::zeros(), Vector3::zeros());
    for &ray in voters {
        let (range, sigma) = (scene.range_m[ray as usize], scene.range_sigma_m[ray as usize]);
        if range.is_finite() && sigma.is_finite() {
            let away = point - scene.ray(ray).center;
            let direction = away.normalize();
            let residual = (away.norm() - range) / sigma;
            let weight = (HUBER_SIGMAS / residual.abs()).min(1.0) / sigma;
            sum.0 += direction * direction.transpose() * (weight / sigma);
            sum.1 += direction * (weight * residual);
        }
    }
    sum
}

/// Voters in runs of one pass.
pub fn by_pass<'a>(scene: &'a Scene, voters: &'a [u32]) -> impl Iterator<Item = &'a [u32]> {
    voters.chunk_by(|&a, &b| scene.view(a).pass == scene.view(b).pass)
}

/// The terms of the voters of one pass at a point; nothing if it is behind one of them.
#[must_use]
pub fn pass_terms(scene: &Scene, noise: &Noise, voters: &[u32], point: &Vector3<f64>) -> Option<PassTerms> {
    PassSums::of(&looks_at(scene, noise, voters, point)?, &vec![1.0; voters.len()]).terms()
}

fn looks_at(scene: &Scene, noise: &Noise, voters: &[u32], point: &Vector3<f64>) -> Option<Vec<Look>> {
    voters.iter().map(|&ray| Look::of(scene, noise, ray, point)).collect()
}

/// One voter's residual at a point, with its derivatives.
struct Look {
    residual: [f64; 2],
    by_point: [Vector3<f64>; 2],
    /// By the shared errors, each in its own sigmas.
    by_shared: [Vector6; 2],
    /// Variance of its own error, px².
    variance: f64,
}

impl Look {
    fn of(scene: &Scene, noise: &Noise, ray: u32, point: &Vector3<f64>) -> Option<Self> {
        let seen = scene.ray(ray);
        let (residual, rows) = seen.linearize(point)?;
        let (position_sigma, rotation_sigma) = noise.shared(scene, ray);
        let away = point - seen.center;
        let by_point = rows.map(|row| row.transpose());
        let by_shared = by_point.map(|column| {
            let (moved, turned) = (column * position_sigma, away.cross(&column) * rotation_sigma);
            Vector6::new(moved.x, moved.y, moved.z, turned.x, turned.y, turned.z)
        });
        let variance = noise.own(scene, ray).variance(seen.project(point).z);
        Some(Self { residual, by_point, by_shared, variance })
    }
}

/// The normal equations of one pass, of the point and of the shared errors.
struct PassSums {
    information: Matrix3<f64>,
    gradient: Vector3<f64>,
    of_shared: Matrix6,
    shared_gradient: Vector6,
    cross: Matrix3x6,
    square: f64,
    log_determinant: f64,
}

impl PassSums {
    fn of(looks: &[Look], weights: &[f64]) -> Self {
        let mut sums = Self {
            information: Matrix3::zeros(),
            gradient: Vector3::zeros(),
            of_shared: Matrix6::identity(), // The prior: shared errors are counted in their own sigmas.
            shared_gradient: Vector6::zeros(),
            cross: Matrix3x6::zeros(),
            square: 0.0,
            log_determinant: 0.0,
        };
        for (look, robust_weight) in looks.iter().zip(weights) {
            let weight = robust_weight / look.variance;
            sums.log_determinant += 2.0 * look.variance.ln();
            for i in 0..2 {
                let (r, column, shared) = (look.residual[i], look.by_point[i], look.by_shared[i]);
                sums.information += column * column.transpose() * weight;
                sums.gradient += column * (r * weight);
                sums.of_shared += shared * shared.transpose() * weight;
                sums.shared_gradient += shared * (r * weight);
                sums.cross += column * shared.transpose() * weight;
                sums.square += r * r * weight;
            }
        }
        sums
    }

    /// What is left about the point when the shared errors are marginalised: Schur complement.
    fn terms(&self) -> Option<PassTerms> {
        let cholesky = self.of_shared.cholesky()?;
        let solved = cholesky.solve(&self.shared_gradient);
        let shared_log_determinant = 2.0 * cholesky.l_dirty().diagonal().iter().map(|d| d.ln()).sum::<f64>();
        Some(PassTerms {
            information: self.information - self.cross * cholesky.solve(&self.cross.transpose()),
            gradient: self.gradient - self.cross * solved,
            square: self.square - self.shared_gradient.dot(&solved),
            log_determinant: self.log_determinant + shared_log_determinant,
        })
    }
}
