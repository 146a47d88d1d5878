//! Measured ranges: `ratio(range_i)` of equation (4) of `docs/method.md`, and an observation of the position.
//!
//! With the logarithms d of the distance of the object and r of the measured range, `d - r` is an error of standard deviation
//! `share`, that of the range relative to the range. Ranges of clutter are distributed as those of all detections. Networks that
//! estimate depth from one picture err widely now and then, so a share of odd ranges bounds what one range says.

use nalgebra::Vector3;

use super::bounded_ln_ratio;
use super::prior::Prior;
use crate::robust::noise::huber::huber_weight;
use crate::robust::scene::Scene;

/// A measured range.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// Logarithm of the depth that an object so far away has, m: along the axis that its detection's depth is measured along.
    pub ln_depth: f64,
    /// Standard deviation in parts of the range.
    share: f64,
}

/// The measured ranges of all rays of a scene, NaN where there is none; empty if none is measured.
#[must_use]
pub fn measured(scene: &Scene) -> Vec<Measured> {
    let of_ray = |(i, (&range_m, &sigma_m)): (usize, (&f64, &f64))| {
        let ray = scene.ray(i as u32);
        let of_one_m = ray.project(&(ray.center + ray.direction)).z;
        Measured { ln_depth: (range_m * of_one_m).ln(), share: sigma_m / range_m }
    };
    let all: Vec<Measured> = scene.range_m.iter().zip(&scene.range_sigma_m).enumerate().map(of_ray).collect();
    if all.iter().any(Measured::is_there) { all } else { Vec::new() }
}

impl Measured {
    /// Whether there is one.
    #[must_use]
    pub fn is_there(&self) -> bool {
        self.ln_depth.is_finite() && self.share.is_finite() && self.share > 0.0
    }

    /// How much more probable it is, in logarithms, of an object at a depth than of clutter; `usual` are mean and standard deviation of those of all
    /// detections, ln m.
    #[must_use]
    pub fn log_ratio(&self, depth_m: f64, usual: (f64, f64)) -> f64 {
        if !self.is_there() || !(self.share < usual.1) {
            return 0.0;
        }
        let at_object = (depth_m.ln() - self.ln_depth) / self.share;
        let as_clutter = (self.ln_depth - usual.0) / usual.1;
        bounded_ln_ratio(usual.1 / self.share, at_object, as_clutter)
    }
}

/// What a range with its standard deviation, m, measured from a camera's centre, says of a point: one more observation, along the line of sight. Nothing
/// where there is none.
#[must_use]
pub fn range_terms([range_m, sigma_m]: [f64; 2], center: &Vector3<f64>, point: &Vector3<f64>) -> Option<Prior> {
    (range_m.is_finite() && sigma_m.is_finite()).then(|| {
        let away = point - center;
        let direction = away.normalize();
        let residual = (away.norm() - range_m) / sigma_m;
        let weight = huber_weight(residual * residual) / sigma_m;
        Prior {
            information: direction * direction.transpose() * (weight / sigma_m),
            gradient: direction * (weight * residual),
            square: weight * sigma_m * residual * residual,
        }
    })
}

#[cfg(test)]
mod tests {
    use super::super::ODD;
    use super::*;

    #[test]
    fn a_range_tells_its_object_and_no_more_than_odd_ones_allow() {
        let range = Measured { ln_depth: 20.0_f64.ln(), share: 0.1 };
        let usual = (15.0_f64.ln(), 0.6);
        assert!(range.log_ratio(20.0, usual) > 1.5);
        assert!((range.log_ratio(60.0, usual) - ODD.ln()).abs() < 1e-6);
        assert!(range.log_ratio(20.0, (15.0_f64.ln(), 0.05)) == 0.0, "all are as far away");
        let none = Measured { ln_depth: f64::NAN, share: f64::NAN };
        assert!(none.log_ratio(20.0, usual) == 0.0);
    }
}
