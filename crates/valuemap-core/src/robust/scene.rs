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
    /// The image of a ray.
    #[inline]
    #[must_use]
    pub fn view(&self, ray: u32) -> &View {
        &self.views[self.rays.image[ray as usize] as usize]
    }

    /// Order rays by pass, then by number.
    pub fn sort_by_pass(&self, rays: &mut [u32]) {
        rays.sort_by_key(|&ray| (self.view(ray).pass, ray));
    }

    /// A ray.
    #[inline]
    #[must_use]
    pub fn ray(&self, ray: u32) -> &Ray {
        &self.rays.rays[ray as usize]
    }

    /// Whether a point lies in the picture of a view.
    #[must_use]
    pub fn is_in_picture(&self, view: &View, point: &Vector3<f64>) -> bool {
        let in_camera = view.cam_from_world * (point - view.center);
        self.frusta[view.camera as usize].normals.iter().all(|normal| normal.dot(&in_camera) >= 0.0)
    }
}

/// Number the viewpoints: within a pass, in the order of the images, a new one begins where the camera has moved
/// by more than `step_m` since the last one began. Also how far the pass had driven there, m: from one to the next.
#[must_use]
pub fn number_viewpoints(centers: &[[f64; 3]], pass: &[u32], step_m: f64) -> Vec<(u32, f64)> {
    let passes = pass.iter().max().map_or(0, |&last| last as usize + 1);
    let mut current: Vec<Option<(Vector3<f64>, u32, f64)>> = vec![None; passes];
    let mut next = 0;
    centers
        .iter()
        .zip(pass)
        .map(|(center, &pass)| {
            let center = Vector3::from(*center);
            let last = current[pass as usize];
            let step = last.map_or(0.0, |(start, ..)| (center - start).norm());
            match last {
                Some((_, viewpoint, driven)) if step <= step_m => (viewpoint, driven),
                _ => {
                    let driven = last.map_or(0.0, |(_, _, driven)| driven + step);
                    current[pass as usize] = Some((center, next, driven));
                    next += 1;
                    (next - 1, driven)
                }
            }
        })
        .collect()
}
