//! How far the passes and the sides of objects agree about where they are.
//!
//! The error that a pass shares makes the positions that each pass alone would give an object differ. The error of the [middle that a side
//! shows](mod@super::sides) makes those of its sides differ by more than those of the passes of one side. So the covariances are off by as much disagreement
//! as there is; the drift is learned of it.

use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use super::estimate::{looks_at, visits};
use super::sides::sides;
use super::{Placed, TELLING_VOTES};
use crate::robust::noise::Noise;
use crate::robust::noise::drift::Drive;
use crate::robust::noise::told::Told;
use crate::robust::scene::Scene;

/// Where passes can disagree in fewer ways, the shared part is taken to be as large as the own part: of so many squares a variance is known to 37 %.
const LEAST_FREEDOM: f64 = 15.0;
/// One label says no more than this about the disagreement of passes, as a multiple of what is expected. Two passes disagree by more in one case of 550 by
/// chance (chi² with three degrees of freedom).
const MOST_DISAGREEMENT: f64 = 5.0;

/// How far positions that parts of what is known of a label give it lie from their mean.
#[derive(Debug, Clone, Copy)]
pub struct Disagreement {
    /// Squared, in sigmas.
    square: f64,
    /// Degrees of freedom.
    freedom: f64,
}

impl Disagreement {
    /// By how many standard deviations it is larger than expected: its cubic root is nearly Gaussian (Wilson and Hilferty, "The distribution of
    /// chi-square", 1931).
    #[must_use]
    pub fn sigmas(&self) -> f64 {
        let variance = 2.0 / (9.0 * self.freedom);
        ((self.square / self.freedom).cbrt() - (1.0 - variance)) / variance.sqrt()
    }
}

/// What the passes of one side say of a label.
struct Side {
    /// Where they put it together, beside where it is, m.
    offset_m: Vector3<f64>,
    /// Covariance of that, m².
    covariance: Matrix3<f64>,
    /// Squared distances of where each puts it alone from there, in sigmas.
    square: f64,
    /// Along how many axes passes can disagree: those that each tells, but for the three of the position.
    freedom: u32,
}

/// What the passes of a label say of it, side by side.
struct Sides(Vec<Side>);

impl Sides {
    /// Of the passes with enough votes to say where they would put the label alone. Nothing if they do not fix the label.
    fn of(scene: &Scene, noise: &Noise, (votes, point): &Placed) -> Option<Self> {
        let passes: Vec<&[u32]> = visits(scene, votes).filter(|pass| pass.len() >= TELLING_VOTES).collect();
        let of_side = |side: &Vec<u32>| {
            let (mut information, mut gradient, mut alone, mut axes) = (Matrix3::zeros(), Vector3::zeros(), 0.0, 0);
            for &pass in side {
                let looks = looks_at(scene, noise, noise, passes[pass as usize], point)?;
                let (of_pass, by_pass) = Drive::at_one(&looks)?.normals.of_one();
                let told = Told::of(&of_pass)?;
                alone += by_pass.dot(&told.solve(&by_pass));
                axes += told.axes();
                information += of_pass;
                gradient += by_pass;
            }
            let covariance = information.cholesky()?.inverse();
            let offset_m = -covariance * gradient;
            let square = (alone + gradient.dot(&offset_m)).max(0.0);
            Some(Side { offset_m, covariance, square, freedom: axes.saturating_sub(3) })
        };
        sides(scene, passes.iter().copied()).iter().map(of_side).collect::<Option<_>>().map(Self)
    }

    /// Of the passes of each side with each other. Nothing if no side has two.
    fn within(&self) -> Option<Disagreement> {
        let freedom = self.0.iter().map(|side| f64::from(side.freedom)).sum();
        let square = self.0.iter().map(|side| side.square).sum();
        (freedom > 0.0).then_some(Disagreement { square, freedom })
    }

    /// Of the sides with each other, if each shows another middle. Nothing if there are no two.
    fn between(&self, side_m: f64) -> Option<Disagreement> {
        let freedom = 3.0 * (self.0.len().checked_sub(1)? as f64);
        let (mut information, mut sum, mut square) = (Matrix3::zeros(), Vector3::zeros(), 0.0);
        for side in &self.0 {
            let of_side = (side.covariance + Matrix3::identity() * (side_m * side_m)).cholesky()?.inverse();
            let weighted = of_side * side.offset_m;
            information += of_side;
            sum += weighted;
            square += side.offset_m.dot(&weighted);
        }
        square -= sum.dot(&information.cholesky()?.solve(&sum));
        (freedom > 0.0).then(|| Disagreement { square: square.max(0.0), freedom })
    }

    /// Of all passes with each other. Nothing if there is only one.
    fn all(&self, side_m: f64) -> Option<Disagreement> {
        let parts = [self.within(), self.between(side_m)];
        parts
            .into_iter()
            .flatten()
            .reduce(|a, b| Disagreement { square: a.square + b.square, freedom: a.freedom + b.freedom })
    }
}

/// How far the positions that the passes of a label give it alone lie from their mean. Nothing for labels of a single pass.
#[must_use]
pub fn disagreement(scene: &Scene, noise: &Noise, label: &Placed) -> Option<Disagreement> {
    Sides::of(scene, noise, label)?.all(noise.side_m)
}

/// That of each of some labels.
#[must_use]
pub fn disagreements(scene: &Scene, noise: &Noise, labels: &[&Placed]) -> Vec<Option<Disagreement>> {
    labels.par_iter().map(|label| disagreement(scene, noise, label)).collect()
}

/// How much larger than they are said to be the errors are that labels of several passes show: the mean disagreement of
/// their passes, at least 1. The variance of positions is to be multiplied by it.
#[must_use]
pub fn variance_factor(scene: &Scene, noise: &Noise, labels: &[Placed]) -> f64 {
    mean(disagreements(scene, noise, &labels.iter().collect::<Vec<_>>())).unwrap_or(1.0).max(1.0)
}

/// Those that are known; nothing if they are too few to tell anything.
#[must_use]
pub fn enough(of_labels: Vec<Option<Disagreement>>) -> Option<Vec<Disagreement>> {
    let known: Vec<Disagreement> = of_labels.into_iter().flatten().collect();
    (known.iter().map(|one| one.freedom).sum::<f64>() >= LEAST_FREEDOM).then_some(known)
}

/// The mean of those that are known, a degree of freedom, without letting one say too much.
#[must_use]
pub fn mean(of_labels: Vec<Option<Disagreement>>) -> Option<f64> {
    let known = enough(of_labels)?;
    Some(known.iter().map(|one| (one.square / one.freedom).min(MOST_DISAGREEMENT)).sum::<f64>() / known.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::street;

    #[test]
    fn a_pass_that_stands_can_disagree_along_two_axes() {
        let errors: Vec<[f64; 2]> = (0..97).map(|i| [(f64::from(i) * 1.7).sin(), (f64::from(i) * 2.3).cos()]).collect();
        let point = Vector3::new(47.0, 5.0, 3.0);
        let freedom = |spacing_m: f64| {
            let drives = [2.0, 2.0, spacing_m].map(|spacing_m| street::street(20, spacing_m, &[point], &errors));
            let scene = street::joined(drives.into());
            let label = (scene.usable_rays(), point);
            disagreement(&scene, &street::NOISE, &label).map(|one| one.freedom)
        };
        assert_eq!(freedom(2.0), Some(6.0));
        // However a car trembles that stands.
        assert_eq!((freedom(0.0), freedom(1e-7)), (Some(5.0), Some(5.0)));
    }
}
