//! How far a detection may be from where its object projects: the pose-aware gate.
//!
//! `sigma² = sigma_px² + (f sigma_position / depth)² + (f sigma_rotation)²`: a pose error of 0.1 m is 1 px at 40 m and
//! 8 px at 5 m, so no single radius in pixels fits.

use super::scene::{Scene, View};
use super::spd::Vector6;
use crate::kernel::Gate;

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
    /// Of the camera position, each axis, shared by a pass, m.
    pub position_drift_m: f64,
    /// Of the camera rotation, each axis, shared by a pass, rad.
    pub rotation_drift_rad: f64,
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

    /// The gate at a number of sigmas.
    #[must_use]
    pub fn gate(&self, sigmas: f64) -> Gate {
        Gate { radius_px: sigmas * self.far_px2.sqrt(), floor_m2: self.near_px2 / self.far_px2 }
    }
}

impl Noise {
    /// The spread of all errors of a ray together.
    #[must_use]
    pub fn total(&self, scene: &Scene, ray: u32) -> Spread {
        let own = self.own(scene, ray);
        let Sigmas { position_m, rotation_rad } = self.shared(scene.view(ray));
        let scale2 = scene.scale2[ray as usize];
        Spread {
            far_px2: own.far_px2 + scale2 * rotation_rad * rotation_rad,
            near_px2: own.near_px2 + scale2 * position_m * position_m,
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
        Sigmas {
            position_m: known_share(view.position_sigma_m, self.position_m, self.position_drift_m),
            rotation_rad: known_share(view.rotation_sigma_rad, self.rotation_rad, self.rotation_drift_rad),
        }
    }

    /// Standard deviations of position (m) and rotation (rad) that an image shares with its pass.
    #[must_use]
    pub fn shared(&self, view: &View) -> Sigmas {
        Sigmas {
            position_m: known_share(view.position_sigma_m, self.position_drift_m, self.position_m),
            rotation_rad: known_share(view.rotation_sigma_rad, self.rotation_drift_rad, self.rotation_rad),
        }
    }
}

/// One part of a total that may be known: then the parts keep the ratio that was estimated.
fn known_share(total: f64, part: f64, other: f64) -> f64 {
    if total.is_nan() || part == 0.0 { part } else { total * part / part.hypot(other) }
}
