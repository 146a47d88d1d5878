//! The noise model: the pose-aware gate of a detection around the projection of its object.
//!
//! `sigma² = sigma_px² + (share of the box)² + (f sigma_position / depth)² + (f side_m / depth)² + (f sigma_rotation)²`: a pose
//! error of 0.1 m is 1 px at 40 m and 8 px at 5 m, so no single radius in pixels fits.

pub mod drift;
pub mod huber;
pub mod index;
pub mod poses;
pub mod spd;
pub mod told;

use rayon::prelude::*;

use crate::kernel::Gate;
use crate::robust::scene::{Scene, View};
use spd::Vector6;

/// Standard deviations of everything that moves a detection off its object.
///
/// Pose errors have a part that each image has for itself and a part that drifts so slowly that the images of
/// a pass which see one object share it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Noise {
    /// Of a small box's centre, each axis, px.
    pub detection_px: f64,
    /// The part of it that grows with the box, as a share of the box's size.
    pub box_share: f64,
    /// Of the camera position, each axis, each image for itself, m.
    pub position_m: f64,
    /// Of the camera rotation, each axis, each image for itself, rad.
    pub rotation_rad: f64,
    /// Of the camera position, each axis, shared by the images of a segment, m.
    pub position_segment_m: f64,
    /// Of the camera rotation, each axis, shared by the images of a segment, rad.
    pub rotation_segment_rad: f64,
    /// Of the camera position, each axis, drifting along a pass, m.
    pub position_drift_m: f64,
    /// Of the camera rotation, each axis, drifting along a pass, rad.
    pub rotation_drift_rad: f64,
    /// Of the middle that a side of an object shows, each axis, shared by all images from that side, m.
    pub side_m: f64,
    /// Correlation of what successive looks at an object are off by themselves, within a segment.
    pub look_correlation: f64,
}

/// Standard deviations of a pose error, each axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sigmas {
    /// Of the position, m.
    pub position_m: f64,
    /// Of the rotation, rad.
    pub rotation_rad: f64,
}

impl Sigmas {
    /// Those of no error.
    pub const NONE: Self = Self { position_m: 0.0, rotation_rad: 0.0 };

    /// All six, position first.
    #[inline]
    #[must_use]
    pub fn each(&self) -> Vector6 {
        let (p, r) = (self.position_m, self.rotation_rad);
        Vector6::new(p, p, p, r, r, r)
    }
}

/// The variance of one ray's residual, each axis, as a function of depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Variance far away, px².
    pub far_px2: f64,
    /// What is added at depth 1 m, px²; it falls with the squared depth.
    pub near_px2: f64,
}

impl Spread {
    /// Variance at a depth, px².
    #[inline]
    #[must_use]
    pub fn variance(&self, depth: f64) -> f64 {
        self.far_px2 + self.near_px2 / (depth * depth)
    }

    /// The share of the variance at a depth that comes from the position of the camera.
    #[inline]
    #[must_use]
    pub fn share_of_position(&self, depth: f64) -> f64 {
        let near_px2 = self.near_px2 / (depth * depth);
        near_px2 / (self.far_px2 + near_px2)
    }

    /// The gate at a number of sigmas.
    #[must_use]
    pub fn gate(&self, sigmas: f64) -> Gate {
        Gate { radius_px: sigmas * self.far_px2.sqrt(), floor_m2: self.near_px2 / self.far_px2 }
    }
}

/// Which parts of the noise the user knows; they stay as they are.
#[derive(Debug, Clone, Copy, Default)]
pub struct Known {
    /// The detections' part.
    pub detection: bool,
    /// The positions' part.
    pub position: bool,
    /// The rotations' part.
    pub rotation: bool,
    /// Detections are off by at least this, px: they are rounded.
    pub least_px: f64,
}

impl Noise {
    /// Noise of the same size of which the images of a drive share nothing.
    #[must_use]
    pub fn all_own(&self) -> Self {
        Self {
            position_m: self.position_m.hypot(self.position_segment_m).hypot(self.position_drift_m),
            rotation_rad: self.rotation_rad.hypot(self.rotation_segment_rad).hypot(self.rotation_drift_rad),
            position_segment_m: 0.0,
            rotation_segment_rad: 0.0,
            position_drift_m: 0.0,
            rotation_drift_rad: 0.0,
            ..*self
        }
    }

    /// The same with all parts that are not known larger by a factor, but for the middles that sides show: these are told beside.
    #[must_use]
    pub fn scaled(&self, factor: f64, known: Known) -> Self {
        let scale = |value: f64, is_known: bool| if is_known { value } else { value * factor };
        Self {
            detection_px: scale(self.detection_px, known.detection),
            box_share: scale(self.box_share, known.detection),
            position_m: scale(self.position_m, known.position),
            rotation_rad: scale(self.rotation_rad, known.rotation),
            position_segment_m: scale(self.position_segment_m, known.position),
            rotation_segment_rad: scale(self.rotation_segment_rad, known.rotation),
            position_drift_m: scale(self.position_drift_m, known.position),
            rotation_drift_rad: scale(self.rotation_drift_rad, known.rotation),
            ..*self
        }
    }

    /// The spread of all errors of a ray together.
    #[must_use]
    pub fn total(&self, scene: &Scene, ray: u32) -> Spread {
        let own = self.own(scene, ray);
        let Sigmas { position_m, rotation_rad } = self.shared(scene.view(ray));
        let scale2 = scene.scale2[ray as usize];
        Spread {
            far_px2: own.far_px2 + scale2 * rotation_rad * rotation_rad,
            near_px2: own.near_px2 + scale2 * (position_m * position_m + self.side_m * self.side_m),
        }
    }

    /// The spread of the errors that a ray does not share with others of its pass.
    #[must_use]
    pub fn own(&self, scene: &Scene, ray: u32) -> Spread {
        let Sigmas { position_m, rotation_rad } = self.of_image(scene.view(ray));
        let scale2 = scene.scale2[ray as usize];
        Spread {
            far_px2: self.detection_px2(scene, ray) + scale2 * rotation_rad * rotation_rad,
            near_px2: scale2 * position_m * position_m,
        }
    }

    /// Variance of a detection alone, each axis, px².
    #[must_use]
    pub fn detection_px2(&self, scene: &Scene, ray: u32) -> f64 {
        let of_box = self.box_share * scene.box_px[ray as usize];
        self.detection_px * self.detection_px + of_box * of_box
    }

    /// Standard deviations of position (m) and rotation (rad) that an image has for itself.
    #[must_use]
    pub fn of_image(&self, view: &View) -> Sigmas {
        self.part(view, self.position_m, self.rotation_rad)
    }

    /// Standard deviations of position (m) and rotation (rad) that the images of a segment share, and no others.
    #[must_use]
    pub fn of_segment(&self, view: &View) -> Sigmas {
        self.part(view, self.position_segment_m, self.rotation_segment_rad)
    }

    /// Standard deviations of position (m) and rotation (rad) that drift along a pass.
    #[must_use]
    pub fn of_drift(&self, view: &View) -> Sigmas {
        self.part(view, self.position_drift_m, self.rotation_drift_rad)
    }

    /// Standard deviations of position (m) and rotation (rad) that an image shares with others of its segment: drift and all.
    #[must_use]
    pub fn shared(&self, view: &View) -> Sigmas {
        let (segment, drift) = (self.of_segment(view), self.of_drift(view));
        Sigmas {
            position_m: norm(segment.position_m, drift.position_m),
            rotation_rad: norm(segment.rotation_rad, drift.rotation_rad),
        }
    }

    /// A part of all errors of a pose; where the total is known, the parts keep the ratio that was estimated.
    fn part(&self, view: &View, position_m: f64, rotation_rad: f64) -> Sigmas {
        let position = || norm(norm(self.position_m, self.position_segment_m), self.position_drift_m);
        let rotation = || norm(norm(self.rotation_rad, self.rotation_segment_rad), self.rotation_drift_rad);
        Sigmas {
            position_m: known_share(view.position_sigma_m, position_m, position),
            rotation_rad: known_share(view.rotation_sigma_rad, rotation_rad, rotation),
        }
    }
}

/// How many times as large as that of independent ones the variance of so many looks of one segment is, if successive ones have a correlation: of their
/// mean it is that of an autoregression, AR(1). One look is as good as ever, and many are (1 + correlation) / (1 - correlation) times as bad, by the
/// integrated autocorrelation time (Sokal, "Monte Carlo methods in statistical mechanics", 1997, section 3).
#[must_use]
pub fn variance_of_alike(looks: usize, correlation: f64) -> f64 {
    let looks = looks as f64;
    looks * (1.0 + correlation) / (looks - (looks - 2.0) * correlation)
}

/// A part of a total that may be known.
fn known_share(known: f64, part: f64, total: impl Fn() -> f64) -> f64 {
    if known.is_nan() || part == 0.0 { part } else { known * part / total() }
}

/// The standard deviation of the sum of two errors.
#[inline]
pub(crate) fn norm(a: f64, b: f64) -> f64 {
    (a * a + b * b).sqrt()
}

/// The spread of every ray.
#[must_use]
pub fn spreads_of(scene: &Scene, noise: &Noise) -> Vec<Spread> {
    (0..scene.rays.rays.len() as u32).into_par_iter().map(|ray| noise.total(scene, ray)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::street;

    #[test]
    fn noise_of_which_images_share_nothing_is_as_large() {
        let shared = Noise {
            position_m: 0.03,
            position_segment_m: 0.04,
            position_drift_m: 0.12,
            rotation_rad: 3e-3,
            rotation_segment_rad: 4e-3,
            rotation_drift_rad: 12e-3,
            ..street::NOISE
        };
        let own = shared.all_own();
        assert!((own.position_m - 0.13).abs() < 1e-12 && (own.rotation_rad - 13e-3).abs() < 1e-12);
        let left = [own.position_segment_m, own.position_drift_m, own.rotation_segment_rad, own.rotation_drift_rad];
        assert_eq!(left.map(f64::to_bits), [0; 4]);
    }
}
