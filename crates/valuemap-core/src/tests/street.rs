//! Random streets, and what the tests on them share.
#![allow(dead_code, missing_docs, clippy::unwrap_used)] // The tests within the core use a part of it.

use std::sync::Arc;

use crate::progress::{Halt, Progress};
use crate::ray::{Ray, Rays};
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::{self, Object, Placed};
use crate::robust::learn::learn;
use crate::robust::model::Model;
use crate::robust::noise::Noise;
use crate::robust::parts::Without;
use crate::robust::scene::{Frustum, Scene, View};
use crate::robust::search::{Depth, search};
use crate::robust::settings::Settings;
use crate::viability::Viability;
use nalgebra::{Isometry3, Matrix3, Vector3};
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

pub const FOCAL_PX: f64 = 600.0;
pub const GATE_SIGMAS: f64 = 3.5;
pub const VIABILITY: Viability =
    Viability { max_reprojection_error_px: f64::NAN, min_parallax_rad: 0.035, min_range_m: 2.0, max_range_m: 60.0 };

pub const SETTINGS: Settings = Settings {
    viability: VIABILITY,
    gate_sigmas: GATE_SIGMAS,
    min_votes: 3,
    least_votes: 3,
    min_existence: 0.5,
    without: Without::NOTHING,
};

/// Without errors that a pass shares, which the quick estimate knows nothing of.
pub const NOISE: Noise = Noise {
    detection_px: 1.0,
    box_share: 0.0,
    position_m: 0.03,
    rotation_rad: 5e-4,
    position_segment_m: 0.0,
    rotation_segment_rad: 0.0,
    position_drift_m: 0.0,
    rotation_drift_rad: 0.0,
    side_m: 0.0,
    look_correlation: 0.0,
};

/// A drive along x that sees all of the objects within 50 m ahead, each a little off.
pub fn street(images: usize, spacing_m: f64, objects: &[Vector3<f64>], errors_px: &[[f64; 2]]) -> Scene {
    let cam_from_world = Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0);
    let centers: Vec<Vector3<f64>> = (0..images).map(|i| Vector3::x() * (spacing_m * i as f64)).collect();
    let mut rays = Rays::default();
    let mut errors = errors_px.iter().cycle();
    for (image, &center) in centers.iter().enumerate() {
        for object in objects {
            let in_cam = cam_from_world * (object - center);
            if in_cam.z > 3.0 && in_cam.norm() < 50.0 {
                let error = errors.next().unwrap();
                let [u, v] = [in_cam.x / in_cam.z + error[0] / FOCAL_PX, in_cam.y / in_cam.z + error[1] / FOCAL_PX];
                let pixels = Matrix3::new(FOCAL_PX, 0.0, -FOCAL_PX * u, 0.0, FOCAL_PX, -FOCAL_PX * v, 0.0, 0.0, 1.0);
                rays.rays.push(Ray {
                    residual_from_world: pixels * cam_from_world,
                    center,
                    direction: (cam_from_world.transpose() * Vector3::new(u, v, 1.0)).normalize(),
                });
                rays.image.push(image as u32);
                rays.class.push(0);
            }
        }
    }
    let count = rays.rays.len();
    let view = |(viewpoint, &center): (u32, &Vector3<f64>)| View {
        center,
        cam_from_world,
        camera: 0,
        pass: 0,
        viewpoint,
        driven_m: center.x,
        position_sigma_m: f64::NAN,
        rotation_sigma_rad: f64::NAN,
    };
    Scene {
        scale2: vec![FOCAL_PX * FOCAL_PX; count],
        box_px: vec![20.0; count],
        score: vec![f64::NAN; count],
        range_m: vec![f64::NAN; count],
        range_sigma_m: vec![f64::NAN; count],
        views: (0..).zip(&centers).map(view).collect(),
        frusta: vec![Frustum { solid_angle_sr: 12.0, ..Frustum::default() }],
        rays: Arc::new(rays),
    }
}

/// A scene elsewhere in the world.
pub fn moved(mut scene: Scene, motion: &Isometry3<f64>) -> Scene {
    let rotation = motion.rotation.to_rotation_matrix();
    for ray in &mut Arc::make_mut(&mut scene.rays).rays {
        ray.residual_from_world *= rotation.matrix().transpose();
        ray.center = motion.rotation * ray.center + motion.translation.vector;
        ray.direction = rotation * ray.direction;
    }
    for view in &mut scene.views {
        view.center = motion.rotation * view.center + motion.translation.vector;
        view.cam_from_world *= rotation.matrix().transpose();
    }
    scene
}

/// Several scenes as one, each a pass of its own.
pub fn joined(scenes: Vec<Scene>) -> Scene {
    let mut all = Scene { frusta: scenes[0].frusta.clone(), ..Scene::default() };
    let mut rays = Rays::default();
    for (pass, scene) in (0..).zip(scenes) {
        let images = all.views.len() as u32;
        rays.rays.extend(&scene.rays.rays);
        rays.image.extend(scene.rays.image.iter().map(|image| image + images));
        rays.class.extend(&scene.rays.class);
        all.scale2.extend(scene.scale2);
        all.box_px.extend(scene.box_px);
        all.score.extend(scene.score);
        all.range_m.extend(scene.range_m);
        all.range_sigma_m.extend(scene.range_sigma_m);
        all.views.extend(scene.views.into_iter().map(|view| View { pass, ..view }));
    }
    Scene { rays: Arc::new(rays), ..all }
}

/// The objects that votes (ascending) with positions nearby make: as they are, or what a search from them ends at.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn objects_of(
    scene: &Scene,
    noise: &Noise,
    settings: &Settings,
    begun: Vec<Placed>,
    is_searched: bool,
    progress: &Progress,
) -> Result<Vec<Object>, Halt> {
    let rays = scene.usable_rays();
    let mut model = Model::new(scene, noise, settings);
    if is_searched {
        return Ok(search(&mut model, &rays, begun, Depth::Deep, true, progress)?.0);
    }
    let lookout = Lookout::new(scene, settings.viability.max_range_m);
    let objects: Vec<Object> =
        begun.into_iter().filter_map(|(votes, point)| energy::object(&model, &lookout, votes, point)).collect();
    learn(&mut model, &lookout, &rays, &objects);
    let again = |o: Object| energy::object(&model, &lookout, o.votes, o.fit.point);
    Ok(objects.into_iter().filter_map(again).collect())
}

pub fn object() -> impl Strategy<Value = Vector3<f64>> {
    (20.0..140.0, 2.0..9.0, prop_oneof![Just(-1.0), Just(1.0)], 1.0..6.0)
        .prop_map(|(x, aside, side, z)| Vector3::new(x, aside * side, z))
}

pub fn errors_px() -> impl Strategy<Value = Vec<[f64; 2]>> {
    vec([-1.0..1.0, -1.0..1.0], 97)
}

/// The same cases in every run.
pub fn config() -> ProptestConfig {
    ProptestConfig { cases: 48, failure_persistence: None, rng_seed: RngSeed::Fixed(1), ..ProptestConfig::default() }
}
