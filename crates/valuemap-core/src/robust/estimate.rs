//! Where an object is, and how sure that is: least squares over its voters, with pose errors that a pass shares.
//!
//! Each pass gives its normal equations with its drift taken out ([`drift`](super::drift)); they add up, and the inverse of
//! their sum is the covariance.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

use super::drift::{Drive, Look, PassTerms};
use super::noise::Noise;
use super::scene::{Scene, View};

const MAX_ITERATIONS: usize = 20;
/// A pass that comes back after so long a drive has another drift, m.
const FORGOTTEN_M: f64 = 250.0;
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
            let drive = Drive::along(&looks[range.clone()], &weights[range])?;
            information += drive.terms.information;
            gradient += drive.terms.gradient;
            alone += drive.alone;
            left.extend(drive.left());
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

/// Whether two views, successive among those of something, are of one visit: of a pass that has not forgotten its drift.
#[must_use]
pub fn is_one_visit(a: &View, b: &View) -> bool {
    a.pass == b.pass && (b.driven_m - a.driven_m).abs() < FORGOTTEN_M
}

/// Voters in runs of one visit.
pub fn by_pass<'a>(scene: &'a Scene, voters: &'a [u32]) -> impl Iterator<Item = &'a [u32]> {
    voters.chunk_by(|&a, &b| is_one_visit(scene.view(a), scene.view(b)))
}

/// The terms of the voters of one pass at a point; nothing if it is behind one of them.
#[must_use]
pub fn pass_terms(scene: &Scene, noise: &Noise, voters: &[u32], point: &Vector3<f64>) -> Option<PassTerms> {
    Some(Drive::along(&looks_at(scene, noise, voters, point)?, &vec![1.0; voters.len()])?.terms)
}

fn looks_at(scene: &Scene, noise: &Noise, voters: &[u32], point: &Vector3<f64>) -> Option<Vec<Look>> {
    voters.iter().map(|&ray| Look::of(scene, noise, ray, point)).collect()
}
