//! The input of the robust method: rays with their boxes, and all images, also those without detections.
//!
//! Images without detections count because they may be misses, equation (5) of `docs/method.md`.

pub mod sample;

use std::f64::consts::{PI, TAU};
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
    /// Height of each ray's box, px.
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
    /// Where a camera that sees all around detects nothing, if anywhere.
    pub blind: Option<BlindSide>,
}

impl Frustum {
    /// How much of the sphere it covers but for its blind side, sr.
    #[must_use]
    pub fn searched_sr(&self) -> f64 {
        self.solid_angle_sr * self.blind.map_or(1.0, |blind| 1.0 - blind.half_width_rad / PI)
    }
}

/// Directions from a camera in which nothing is ever detected: of panoramas often a part alone is searched.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BlindSide {
    /// Its middle, rad: about the vertical axis of the camera, 0 ahead and positive to the right.
    pub middle_rad: f64,
    /// Half of its width, rad.
    pub half_width_rad: f64,
}

/// A gap between detections is a blind side if so many would be in it were they as many everywhere: even where they are twenty times as rare as
/// elsewhere, one gap in 150 would be as empty by chance.
const ENOUGH_FOR_BLIND: f64 = 100.0;

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
        &self.views[self.image_of(ray) as usize]
    }

    /// The number of the image of a ray.
    #[inline]
    #[must_use]
    pub fn image_of(&self, ray: u32) -> u32 {
        self.rays.image[ray as usize]
    }

    /// The class that a ray is said to be of.
    #[inline]
    #[must_use]
    pub fn class_of(&self, ray: u32) -> u32 {
        self.rays.class[ray as usize]
    }

    /// A ray.
    #[inline]
    #[must_use]
    pub fn ray(&self, ray: u32) -> &Ray {
        &self.rays.rays[ray as usize]
    }

    /// What all images picture together, sr, but for blind sides.
    #[must_use]
    pub fn solid_angle_sr(&self) -> f64 {
        self.views.iter().map(|view| self.frusta[view.camera as usize].searched_sr()).sum()
    }

    /// Whether a point lies in the picture of a view.
    #[must_use]
    pub fn is_in_picture(&self, view: &View, point: &Vector3<f64>) -> bool {
        let in_camera = view.cam_from_world * (point - view.center);
        let frustum = &self.frusta[view.camera as usize];
        frustum.normals.iter().all(|normal| normal.dot(&in_camera) >= 0.0)
            && frustum.blind.is_none_or(|blind| !blind.covers(azimuth_rad(&in_camera)))
    }

    /// Find where cameras that see all around detect nothing: the widest gap between detections, if it is no chance.
    pub fn find_blind_sides(&mut self) {
        let mut azimuths: Vec<Vec<f64>> = vec![Vec::new(); self.frusta.len()];
        for ray in self.usable_rays() {
            let view = self.view(ray);
            if self.frusta[view.camera as usize].normals.is_empty() {
                azimuths[view.camera as usize].push(azimuth_rad(&(view.cam_from_world * self.ray(ray).direction)));
            }
        }
        for (frustum, azimuths) in self.frusta.iter_mut().zip(azimuths) {
            frustum.blind = BlindSide::of(azimuths);
        }
    }
}

/// The direction of a point in camera axes about the vertical axis, rad.
fn azimuth_rad(in_camera: &Vector3<f64>) -> f64 {
    in_camera.x.atan2(in_camera.z)
}

impl BlindSide {
    /// The widest gap between some azimuths, rad, if it is no chance.
    fn of(mut azimuths_rad: Vec<f64>) -> Option<Self> {
        azimuths_rad.sort_by(f64::total_cmp);
        let (first, last) = (*azimuths_rad.first()?, *azimuths_rad.last()?);
        let gaps = azimuths_rad.windows(2).map(|pair| (pair[1] - pair[0], pair[0]));
        let (width, begin) = gaps.fold((first + TAU - last, last), |a, b| if b.0 > a.0 { b } else { a });
        let expected = width / TAU * azimuths_rad.len() as f64;
        let side = Self { middle_rad: begin + 0.5 * width, half_width_rad: 0.5 * width };
        (expected >= ENOUGH_FOR_BLIND).then_some(side)
    }

    fn covers(&self, azimuth_rad: f64) -> bool {
        let away = (azimuth_rad - self.middle_rad + PI).rem_euclid(TAU) - PI;
        away.abs() < self.half_width_rad
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::street;

    #[test]
    fn the_side_on_which_nothing_is_detected_is_not_looked_at() {
        // To the right of a drive along x, from 12 degrees ahead to 12 degrees behind it.
        let objects: Vec<Vector3<f64>> = (0..60).map(|i| Vector3::new(2.0 * f64::from(i), -5.0, 3.0)).collect();
        let mut scene = street::street(60, 2.0, &objects, &[[0.0, 0.0]]);
        let (ahead, right, left) = (Vector3::x() * 40.0, Vector3::y() * -10.0, Vector3::y() * 10.0);
        let sees =
            |scene: &Scene, to: &Vector3<f64>| scene.is_in_picture(&scene.views[0], &(scene.views[0].center + to));
        scene.find_blind_sides();
        assert!(scene.frusta[0].blind.is_some());
        assert!(!sees(&scene, &left) && !sees(&scene, &-ahead));
        assert!(sees(&scene, &(ahead + right)));
        // Clutter is as dense as it is where anything is detected.
        let share = scene.frusta[0].searched_sr() / scene.frusta[0].solid_angle_sr;
        assert!((0.1..0.2).contains(&share), "{share}");
        let whole_sr = scene.frusta[0].solid_angle_sr * scene.views.len() as f64;
        assert!((scene.solid_angle_sr() / whole_sr - share).abs() < 1e-9);
        // A camera with bounds has no other side, and few detections tell none.
        scene.frusta[0].normals = vec![Vector3::z()];
        scene.find_blind_sides();
        assert!(scene.frusta[0].blind.is_none());
        let mut few = street::street(6, 2.0, &objects[..3], &[[0.0, 0.0]]);
        few.find_blind_sides();
        assert!(few.frusta[0].blind.is_none() && sees(&few, &left));
    }

    #[test]
    fn a_gap_may_lie_behind() {
        let ahead: Vec<f64> = (0..400).map(|i| -1.0 + 0.005 * f64::from(i)).collect();
        let blind = BlindSide::of(ahead).unwrap_or(BlindSide { middle_rad: 0.0, half_width_rad: 0.0 });
        assert!(blind.covers(PI) && blind.covers(-PI) && blind.covers(1.1) && blind.covers(-1.1));
        assert!(!blind.covers(0.9) && !blind.covers(-0.9));
        assert_eq!(BlindSide::of((0..400).map(|i| -PI + TAU * f64::from(i) / 400.0).collect()), None);
        assert_eq!(BlindSide::of(Vec::new()), None);
    }
}
