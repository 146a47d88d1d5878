//! Sides: boxes of a thing that is not a point have another middle from each side.
//!
//! The middle that a side shows is the object's position plus an error of its own, of [`side_m`](crate::robust::noise::Noise::side_m) on each axis. It is one more error that equation
//! (1) marginalises: all visits of a side share it, whatever their passes drift. How large it is, all objects tell together (`refine/middles.py`).

use nalgebra::{Matrix3, Vector3};

use super::by_side;
use crate::robust::noise::drift::Drive;
use crate::robust::scene::Scene;

/// Visits whose mean directions are within 45 degrees look from one side: a box has four.
pub(crate) const LEAST_COSINE: f64 = std::f64::consts::FRAC_1_SQRT_2;

/// The numbers of the visits (of rays, in their order) that look from one side each. It depends on the rays alone, not on where their object is.
pub(crate) fn sides<'v>(scene: &Scene, visits: impl Iterator<Item = &'v [u32]>) -> Vec<Vec<u32>> {
    of_directions(visits.map(|visit| visit.iter().map(|&ray| scene.ray(ray).direction).sum()))
}

/// The numbers of the visits that look from one side each, by their directions (of any length).
pub fn of_directions(directions: impl Iterator<Item = Vector3<f64>>) -> Vec<Vec<u32>> {
    by_side((0..).zip(directions.map(|direction| direction.normalize())), LEAST_COSINE)
}

/// What a visit or a side says of an object: information, 1/m², and gradient, 1/m, of half of its squared residuals, and its part of equation (1).
#[derive(Debug, Clone)]
pub(crate) struct Said {
    pub(crate) information: Matrix3<f64>,
    pub(crate) gradient: Vector3<f64>,
    pub(crate) energy: f64,
}

impl Said {
    /// What a visit at one object says of it.
    pub(crate) fn of(drive: &Drive<'_>) -> Self {
        let (information, gradient) = drive.normals.of_one();
        Self { information, gradient, energy: drive.normals.square + drive.log_determinant() }
    }
}

/// The middle that a side shows.
#[derive(Debug, Clone)]
pub(crate) struct Middle {
    /// How far from the object's position it probably is, m.
    offset_m: Vector3<f64>,
    /// Covariance of that if the object's position is known, m².
    covariance: Matrix3<f64>,
    /// What it moves by with the object's position, the votes of its side as they are.
    by_point: Matrix3<f64>,
}

/// What a side says of an object at a point with the error of its middle marginalised; `say` tells what it says of a point.
pub(crate) fn marginalised(
    side_m: f64,
    point: &Vector3<f64>,
    mut say: impl FnMut(&Vector3<f64>) -> Option<Said>,
) -> Option<(Said, Middle)> {
    let stiffness = Matrix3::identity() / (side_m * side_m);
    let at_point = say(point)?;
    let offset_m = -(at_point.information + stiffness).cholesky()?.solve(&at_point.gradient);
    at_middle(side_m, offset_m, &say(&(point + offset_m))?)
}

/// The same from what a side says of where its middle is expected, so far from the point, m.
pub(crate) fn at_middle(side_m: f64, offset_m: Vector3<f64>, said: &Said) -> Option<(Said, Middle)> {
    let stiffness = Matrix3::identity() / (side_m * side_m);
    let Said { information, gradient, energy } = *said;
    let covariance = (information + stiffness).cholesky()?.inverse();
    // What is left of the step to the likeliest middle: nothing where residuals are linear.
    let rest = gradient + stiffness * offset_m;
    let by_point = Matrix3::identity() - covariance * information;
    let ln_determinant = (Matrix3::identity() + information * (side_m * side_m)).determinant().ln();
    let said = Said {
        information: information * by_point,
        gradient: gradient - information * (covariance * rest),
        energy: energy + offset_m.dot(&(stiffness * offset_m)) - rest.dot(&(covariance * rest)) + ln_determinant,
    };
    Some((said, Middle { offset_m, covariance, by_point }))
}

impl Middle {
    /// Where it is, and the covariance of that, m², of an object at a point with a covariance, m².
    pub(crate) fn of(&self, point: &Vector3<f64>, covariance: &Matrix3<f64>) -> (Vector3<f64>, Matrix3<f64>) {
        (point + self.offset_m, self.by_point * covariance * self.by_point.transpose() + self.covariance)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;

    /// Linear residuals: what a side says of a point is a square around where it sees the middle.
    fn side(middle: Vector3<f64>, information: Matrix3<f64>) -> impl FnMut(&Vector3<f64>) -> Option<Said> {
        move |point| {
            let away = point - middle;
            let gradient = information * away;
            Some(Said { information, gradient, energy: away.dot(&gradient) })
        }
    }

    #[test]
    fn what_sides_say_with_their_middles_marginalised_is_what_a_gaussian_of_all_says() {
        let side_m = 0.2;
        let middles = [Vector3::new(0.1, 0.3, -0.2), Vector3::new(-0.2, 0.1, 0.4)];
        let informations = [
            Matrix3::new(40.0, 5.0, 0.0, 5.0, 30.0, 2.0, 0.0, 2.0, 60.0),
            Matrix3::new(20.0, -4.0, 1.0, -4.0, 70.0, 0.0, 1.0, 0.0, 10.0),
        ];
        let point = Vector3::new(0.05, -0.1, 0.2);
        let said: Vec<(Said, Middle)> = middles
            .iter()
            .zip(informations)
            .filter_map(|(middle, information)| marginalised(side_m, &point, side(*middle, information)))
            .collect();
        // Each side sees the object with the covariance of its own and that of middles.
        for (((said, _), middle), information) in said.iter().zip(&middles).zip(informations) {
            let covariance = information.try_inverse().unwrap_or_default() + Matrix3::identity() * side_m.powi(2);
            let expected = covariance.try_inverse().unwrap_or_default();
            let away = point - middle;
            let ln_determinant = (covariance * information).determinant().ln();
            assert!((said.information - expected).norm() < 1e-9);
            assert!((said.gradient - expected * away).norm() < 1e-9);
            assert!((said.energy - away.dot(&(expected * away)) - ln_determinant).abs() < 1e-9);
        }
        // Position and middles together, the position at where the sides put it.
        let mut all = DMatrix::<f64>::zeros(9, 9);
        let mut gradient = DVector::<f64>::zeros(9);
        let tie = Matrix3::identity() / side_m.powi(2);
        for (k, (middle, information)) in middles.iter().zip(informations).enumerate() {
            let at = 3 + 3 * k;
            for (row, column, block) in [(0, 0, tie), (at, at, tie + information), (0, at, -tie), (at, 0, -tie)] {
                let mut view = all.fixed_view_mut::<3, 3>(row, column);
                view += block;
            }
            let mut view = gradient.fixed_rows_mut::<3>(at);
            view += information * middle;
        }
        let covariance = all.try_inverse().unwrap_or_else(|| DMatrix::zeros(9, 9));
        let means = &covariance * gradient;
        let block = |k: usize| covariance.fixed_view::<3, 3>(3 * k, 3 * k).into_owned();
        let of_point: Matrix3<f64> = said.iter().map(|(said, _)| said.information).sum();
        assert!((of_point.try_inverse().unwrap_or_default() - block(0)).norm() < 1e-9);
        let there = Vector3::new(means[0], means[1], means[2]);
        for (k, (middle, information)) in middles.iter().zip(informations).enumerate() {
            let found = marginalised(side_m, &there, side(*middle, information));
            let (seen, of_seen) = found.map(|(_, middle)| middle.of(&there, &block(0))).unwrap_or_default();
            assert!((seen - means.fixed_rows::<3>(3 + 3 * k)).norm() < 1e-9);
            assert!((of_seen - block(k + 1)).norm() < 1e-9);
        }
    }
}
