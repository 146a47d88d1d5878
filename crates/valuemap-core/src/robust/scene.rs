//! What the robust method knows: rays with their boxes, and all images, also those without detections.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};

use crate::ray::{Ray, Rays};

/// Everything that was seen, and from where.
#[derive(Debug, Default, Clone)]
pub struct Scene {
    /// Viewing rays with image and class.
    pub rays: Arc<Rays>,
    /// Squared pixels that a unit of each ray's virtual image plane spans, see [`Ray::pixels_per_unit2`].
    pub scale2: Vec<f64>,
    /// Size of each ray's box, px (geometric mean of width and height).
    pub box_px: Vec<f64>,
    /// Score of each ray's detection; NaN where there is none.
    pub score: Vec<f64>,
    /// Measured range of each ray, m; NaN where there is none.
    pub range_m: Vec<f64>,
    /// Standard deviation of that range, m.
    pub range_sigma_m: Vec<f64>,
    /// All images.
    pub views: Vec<View>,
    /// Picture bounds of each camera, see [`Scene::is_in_picture`].
    pub frusta: Vec<Frustum>,
}

/// One image: where it was taken, by which camera, in which pass.
#[derive(Debug, Clone, Copy)]
pub struct View {
    /// Camera centre in the world, m.
    pub center: Vector3<f64>,
    /// Rotation of the world into the camera.
    pub cam_from_world: Matrix3<f64>,
    /// Index of the camera's frustum.
    pub camera: u32,
    /// The pass.
    pub pass: u32,
    /// The place of the pass where it was taken: images of one viewpoint see the same, e.g. before a red light.
    pub viewpoint: u32,
    /// How far the pass had driven there, m.
    pub driven_m: f64,
    /// Known standard deviation of the position, m; NaN where it is to be estimated.
    pub position_sigma_m: f64,
    /// Known standard deviation of the rotation, rad; NaN where it is to be estimated.
    pub rotation_sigma_rad: f64,
}

/// The part of space that a camera pictures.
#[derive(Debug, Clone, Default)]
pub struct Frustum {
    /// Points in camera axes with non-negative products with all of these are in the picture. None for cameras that
    /// see all around.
    pub normals: Vec<Vector3<f64>>,
    /// How much of the sphere it covers, sr.
    pub solid_angle_sr: f64,
}

impl Scene {
    /// The median of a number that views state, if most of them do.
    #[must_use]
    pub fn usual(&self, of_view: impl Fn(&View) -> f64) -> Option<f64> {
        let mut stated: Vec<f64> = self.views.iter().map(of_view).filter(|value| value.is_finite()).collect();
        let middle = stated.len() / 2;
        (2 * stated.len() > self.views.len()).then(|| *stated.select_nth_unstable_by(middle, f64::total_cmp).1)
    }

    /// The rays, ascending, that propose and vote: detections whose camera has a ray for them, and that are no other's double.
    #[must_use]
    pub fn usable_rays(&self) -> Vec<u32> {
        (0..self.rays.rays.len() as u32).filter(|&ray| self.ray(ray).is_usable()).collect()
    }

    /// The image of a ray.
    #[inline]
    #[must_use]
    pub fn view(&self, ray: u32) -> &View {
        &self.views[self.rays.image[ray as usize] as usize]
    }

    /// A ray.
    #[inline]
    #[must_use]
    pub fn ray(&self, ray: u32) -> &Ray {
        &self.rays.rays[ray as usize]
    }

    /// What all images picture together, sr.
    #[must_use]
    pub fn solid_angle_sr(&self) -> f64 {
        self.views.iter().map(|view| self.frusta[view.camera as usize].solid_angle_sr).sum()
    }

    /// Whether a point lies in the picture of a view.
    #[must_use]
    pub fn is_in_picture(&self, view: &View, point: &Vector3<f64>) -> bool {
        let in_camera = view.cam_from_world * (point - view.center);
        self.frusta[view.camera as usize].normals.iter().all(|normal| normal.dot(&in_camera) >= 0.0)
    }
}
