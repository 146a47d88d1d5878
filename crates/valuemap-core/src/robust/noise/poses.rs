//! Pose errors of the images of a pass, as far as its votes tell: the drift, smoothed along the drive.
//!
//! Every vote for a label measures the pose error of its image. The drift is the Markov process of [`drift`](super::drift): a
//! two-filter smoother passes what the looks of each segment say of it to the segments after and before.

use nalgebra::{Matrix2, SMatrix, Vector2};

use super::Sigmas;
use super::drift::{DRIFT_LENGTH_M, Look, SEGMENT_M};
use super::spd::{Inverse, Matrix6, Vector6, product, product_transposed, scaled};
use crate::robust::scene::View;

/// Segments before and after those in question that say something about their drift. Of a drift farther away less than a seventh is left (`DRIFT_LENGTH_M`).
pub(crate) const SEGMENTS_AROUND: usize = 20;

/// What is known of the drift of a segment, in sigmas of the drift: information and gradient.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Belief {
    information: Matrix6,
    gradient: Vector6,
}

/// A pose error: position, m, and rotation, rad, both in the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseError {
    /// The most probable error with its sign turned: what is to be added to residuals.
    pub mean: Vector6,
    /// Its covariance.
    pub covariance: Matrix6,
}

impl Belief {
    /// No knowledge at all.
    #[must_use]
    pub fn nothing() -> Self {
        Self { information: Matrix6::zeros(), gradient: Vector6::zeros() }
    }

    /// Before anything is seen: drifts are counted in their own sigmas.
    #[must_use]
    pub fn prior() -> Self {
        Self { information: Matrix6::identity(), gradient: Vector6::zeros() }
    }

    /// Both beliefs, which must not rest on the same looks.
    #[must_use]
    pub fn and(mut self, other: &Self) -> Self {
        self.add(other);
        self
    }

    /// Add another belief, which must not rest on the same looks.
    pub fn add(&mut self, other: &Self) {
        self.information += other.information;
        self.gradient += other.gradient;
    }

    /// What it was before another belief, which is part of it, was added.
    #[must_use]
    pub fn without(mut self, other: &Self) -> Self {
        self.take(other);
        self
    }

    /// Take another belief, which is part of it, out.
    pub fn take(&mut self, other: &Self) {
        self.information -= other.information;
        self.gradient -= other.gradient;
    }

    /// What a vote says; `variance` is that of its residual, px², each axis.
    #[must_use]
    pub fn of_vote(look: &Look, variance: f64) -> Self {
        let mut belief = Self::nothing();
        let drift = look.shared_sigma().each();
        for i in 0..2 {
            let shared = look.by_pose(i).component_mul(&drift);
            belief.information += shared * shared.transpose() / variance;
            belief.gradient += shared * (look.residual[i] / variance);
        }
        belief
    }

    /// What it says of the drift `distance_m` farther along the drive; `is_prior` if it holds the prior already.
    fn carried(&self, distance_m: f64, is_prior: bool) -> Self {
        let keep = (-distance_m / DRIFT_LENGTH_M).exp();
        let stiffness = 1.0 / (1.0 - keep * keep);
        let tie = keep * stiffness;
        // The new drift is `keep` times the old one and something new of variance 1 - keep².
        let (own, of_new) = if is_prior { (keep * tie, stiffness) } else { (stiffness, keep * tie) };
        let Some(tied) = Inverse::of(&(self.information + Matrix6::identity() * own)) else { return Self::nothing() };
        Self {
            information: Matrix6::identity() * of_new - tied.matrix * (tie * tie),
            gradient: product(&tied.matrix, &self.gradient) * tie,
        }
    }

    /// The drift of an image, and the error that it has for itself; both with their standard deviations of position, m, and
    /// rotation, rad.
    #[must_use]
    pub fn pose_error(&self, drift: Sigmas, own: Sigmas) -> PoseError {
        let (drift, own) = (drift.each(), own.each());
        let covariance = Inverse::of(&self.information).map_or_else(Matrix6::identity, |inverse| inverse.matrix);
        let mean = -product(&covariance, &self.gradient);
        PoseError {
            mean: mean.component_mul(&drift),
            covariance: scaled(&covariance, &drift) + Matrix6::from_diagonal(&own.component_mul(&own)),
        }
    }
}

impl PoseError {
    /// Before anything is seen: standard deviations of the drift, and of the error that an image has for itself.
    #[must_use]
    pub fn prior(drift: Sigmas, own: Sigmas) -> Self {
        let [drift_2, own_2] = [drift, own].map(|sigmas| sigmas.each().component_mul(&sigmas.each()));
        Self { mean: Vector6::zeros(), covariance: Matrix6::from_diagonal(&(drift_2 + own_2)) }
    }

    /// Residual of a look, px, with this error taken out, and its covariance; `own` is the covariance of all that is not the
    /// pose's, px².
    #[must_use]
    pub fn expected(&self, look: &Look, own: &Matrix2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        let by_pose = rows_of(look);
        let residual = Vector2::from(look.residual) + product(&by_pose, &self.mean);
        (residual, own + product_transposed(&product(&by_pose, &self.covariance), &by_pose))
    }

    /// Its standard deviations, root mean squares of the axes.
    #[must_use]
    pub fn sigmas(&self) -> Sigmas {
        let [position_m, rotation_rad] = [0, 3].map(|first| {
            let variance = self.covariance.diagonal().fixed_rows::<3>(first).mean();
            variance.sqrt()
        });
        Sigmas { position_m, rotation_rad }
    }

    /// The error after a look at a label was found to be right (Kalman).
    #[must_use]
    pub fn after(&self, look: &Look, own: &Matrix2<f64>) -> Self {
        let (residual, covariance) = self.expected(look, own);
        let Some(inverse) = covariance.try_inverse() else { return *self };
        let seen = product(&rows_of(look), &self.covariance);
        let gain = seen.tr_mul(&inverse);
        Self { mean: self.mean - gain * residual, covariance: self.covariance - gain * seen }
    }
}

fn rows_of(look: &Look) -> SMatrix<f64, 2, 6> {
    SMatrix::<f64, 2, 6>::from_rows(&[look.by_pose(0).transpose(), look.by_pose(1).transpose()])
}

/// The drives of a scene, cut into segments of one drift each.
pub struct Segments {
    /// The segment of each view.
    pub of_view: Vec<u32>,
    /// The pass of each segment, ascending.
    pub pass: Vec<u32>,
    /// Where each segment begins, m driven.
    pub start_m: Vec<f64>,
}

impl Segments {
    /// Cut the drives of all passes.
    #[must_use]
    pub fn new(views: &[View]) -> Self {
        let step_of = |view: &View| (view.pass, (view.driven_m / SEGMENT_M).floor() as i64);
        let mut steps: Vec<(u32, i64)> = views.iter().map(step_of).collect();
        steps.sort_unstable();
        steps.dedup();
        let of_view = views.iter().map(|view| steps.partition_point(|step| *step < step_of(view)) as u32).collect();
        let start_m = steps.iter().map(|(_, step)| *step as f64 * SEGMENT_M).collect();
        Self { of_view, pass: steps.into_iter().map(|(pass, _)| pass).collect(), start_m }
    }
}

/// What is known of the drift of each segment, from its own looks and those of all other segments of the pass; `starts_m` is where
/// the segments begin.
#[must_use]
pub fn smooth(starts_m: &[f64], looks: &[Belief]) -> Vec<Belief> {
    let distance = |segment: usize| (starts_m[segment + 1] - starts_m[segment]).abs();
    let mut before = vec![Belief::prior(); looks.len()];
    for segment in 1..looks.len() {
        before[segment] = before[segment - 1].and(&looks[segment - 1]).carried(distance(segment - 1), true);
    }
    let mut after = Belief::nothing();
    let mut smoothed = before;
    for segment in (0..looks.len()).rev() {
        smoothed[segment].add(&looks[segment]);
        smoothed[segment].add(&after);
        if segment > 0 {
            after = after.and(&looks[segment]).carried(distance(segment - 1), false);
        }
    }
    smoothed
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_seen_is_off_by_drift_and_own_error() {
        let drift = Sigmas { position_m: 0.3, rotation_rad: 0.007 };
        let own = Sigmas { position_m: 0.1, rotation_rad: 0.002 };
        assert_eq!(PoseError::prior(drift, own), Belief::prior().pose_error(drift, own));
    }
}
