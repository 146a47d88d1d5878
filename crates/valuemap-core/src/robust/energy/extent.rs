//! Where an object may be.

use nalgebra::Vector3;

use super::{Fit, Object};
use crate::robust::model::Model;
use crate::robust::noise::{Noise, norm};

/// Detections are looked for as far from an object as this many of its standard deviations. One in 16,000 is farther off (normal distribution).
pub(crate) const REACH_SIGMAS: f64 = 4.0;
/// In so many steps at least, which are no longer than a standard deviation.
const LEAST_STEPS: f64 = 4.0;
/// And at most: an object whose depth is hardly known is looked for where it may be by its size, not for ever.
const MOST_STEPS: f64 = 32.0;

impl Object {
    /// Where it may be: along the direction that it is least known in, so densely that gates leave no gap.
    #[must_use]
    pub fn places(&self, model: &Model<'_>) -> Vec<Vector3<f64>> {
        let Fit { point, covariance, .. } = &self.fit;
        let axes = covariance.symmetric_eigen();
        let longest = axes.eigenvalues.imax();
        let variance_m2 = axes.eigenvalues[longest].max(0.0);
        let across_m2 = axes.eigenvalues.sum() - axes.eigenvalues[longest];
        if variance_m2 < 4.0 * across_m2.max(0.0) {
            return vec![*point];
        }
        let reach_m = REACH_SIGMAS * variance_m2.sqrt();
        // A gate is at least as wide as errors of position make it.
        let Noise { position_m, position_segment_m, position_drift_m, .. } = *model.noise;
        let gate_m = model.settings.gate_sigmas * norm(norm(position_m, position_segment_m), position_drift_m);
        let steps = (reach_m / gate_m).ceil().clamp(LEAST_STEPS, MOST_STEPS);
        let reach = axes.eigenvectors.column(longest) * reach_m;
        (-steps as i32..=steps as i32).map(|step| point + reach * (f64::from(step) / steps)).collect()
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix3;

    use super::super::anywhere;
    use super::super::seen::Seen;
    use super::*;
    use crate::street;

    #[test]
    fn places_along_a_badly_known_axis_leave_no_gap_between_gates() {
        let noise = Noise { position_m: 0.5, ..street::NOISE };
        let scene = street::street(4, 1.0, &[Vector3::new(20.0, 3.0, 2.0)], &[[0.0, 0.0]]);
        let model = Model::new(&scene, &noise, &street::SETTINGS);
        let of = |sigma_m: f64| {
            let mut object = anywhere(3, Seen::default(), -10.0);
            object.fit.covariance = Matrix3::from_diagonal(&Vector3::new(sigma_m * sigma_m, 0.04, 0.04));
            object.places(&model)
        };
        let places = of(4.0);
        let reach_m = (places[places.len() - 1] - places[0]).norm();
        assert!((reach_m - 2.0 * 4.0 * REACH_SIGMAS).abs() < 1e-9, "{reach_m}");
        let gate_m = street::GATE_SIGMAS * noise.position_m;
        assert!(places.windows(2).all(|pair| (pair[1] - pair[0]).norm() <= gate_m));
        // What is known as well in all directions is where it is; what is not known at all is not looked for everywhere.
        assert_eq!((of(0.3).len(), of(1e6).len()), (1, 1 + 2 * MOST_STEPS as usize));
    }
}
