//! A detector that takes what is of one class for another one.

use std::sync::Arc;

use crate::progress::Progress;
use crate::robust::calibrate::{Calibration, self_calibrate};
use crate::robust::find;
use crate::robust::finish::Finding;
use crate::robust::model::confusions::Confusions;
use crate::robust::noise::Known;
use crate::robust::scene::Scene;
use crate::robust::settings::Settings;
use nalgebra::Vector3;

use crate::street::{NOISE, SETTINGS, joined, street};

/// Twenty lights on the left and twenty signs on the right, and their classes.
fn objects() -> Vec<(Vector3<f64>, u32)> {
    let side = |class: u32| {
        let of = if class == 0 { 1.0 } else { -1.0 };
        (0..20).map(move |i| (Vector3::new(20.0 + 11.0 * f64::from(i), 5.0 * of, 3.0 + of), class))
    };
    side(0).chain(side(1)).collect()
}

/// Two drives past these, each of which takes every seventh detection of a light for a sign.
fn confused_street(objects: &[(Vector3<f64>, u32)]) -> Scene {
    let points: Vec<Vector3<f64>> = objects.iter().map(|object| object.0).collect();
    let errors = [[0.3, -0.2], [-0.4, 0.1], [0.2, 0.4], [-0.1, -0.3], [0.5, 0.2]];
    let mut scene = joined(vec![street(130, 2.0, &points, &errors), street(130, 2.0, &points, &errors[2..])]);
    let said: Vec<u32> = (0..scene.rays.rays.len() as u32).map(|ray| class_of(&scene, objects, ray)).collect();
    let lights = (0..said.len()).filter(|&ray| said[ray] == 0).enumerate();
    let confused: Vec<usize> = lights.filter(|(i, _)| i % 7 == 3).map(|(_, ray)| ray).collect();
    let rays = Arc::make_mut(&mut scene.rays);
    rays.class = said;
    for ray in confused {
        rays.class[ray] = 1;
    }
    scene
}

/// The class of the object that a ray shows.
fn class_of(scene: &Scene, objects: &[(Vector3<f64>, u32)], ray: u32) -> u32 {
    let error = |object: &&(Vector3<f64>, u32)| scene.ray(ray).squared_error(&object.0);
    objects.iter().min_by(|a, b| error(a).total_cmp(&error(b))).unwrap().1
}

fn calibrated(scene: &Scene) -> Calibration {
    let known = Known { detection: true, position: true, rotation: true, least_px: 0.0 };
    self_calibrate(scene, &NOISE, known, &SETTINGS, false, None, &Progress::default()).unwrap().0
}

fn found(scene: &Scene, calibration: &Calibration) -> Vec<Finding> {
    find(scene, calibration, &Settings { least_votes: 1, ..SETTINGS }, &Progress::default()).unwrap().findings
}

#[test]
fn what_is_taken_for_another_class_is_one_object_of_its_own() {
    let objects = objects();
    let scene = confused_street(&objects);
    let calibration = calibrated(&scene);
    let share = |object, said| calibration.confusions.ln_share(object, said).exp();
    assert!((share(0, 1) - 1.0 / 7.0).abs() < 0.03 && share(1, 0) < 1e-12, "{:?}", calibration.confusions);

    let map = found(&scene, &calibration);
    assert_eq!(map.len(), objects.len());
    for finding in &map {
        let near = objects.iter().find(|object| (object.0 - finding.estimate.point).norm() < 1.0).unwrap();
        assert_eq!(finding.class, near.1);
    }
    let confused =
        |finding: &&Finding| finding.votes.iter().any(|&ray| scene.rays.class[ray as usize] != finding.class);
    assert!(map.iter().filter(confused).count() > 15);

    let without = found(&scene, &Calibration { confusions: Confusions::default(), ..calibration });
    assert!(without.len() > objects.len(), "{}", without.len());
}

#[test]
fn classes_of_few_objects_are_confused_like_all_together() {
    let objects: Vec<(Vector3<f64>, u32)> =
        objects().into_iter().filter(|object| object.1 == 0 || object.0.x < 60.0).collect();
    let confusions = calibrated(&confused_street(&objects)).confusions;
    let share = |object, said| confusions.ln_share(object, said).exp();
    assert!((0.5 * share(0, 1)..share(0, 1)).contains(&share(1, 0)), "{confusions:?}");
}

#[test]
fn what_stands_beside_is_no_confusion() {
    let lights = objects().into_iter().filter(|object| object.1 == 0);
    let both: Vec<(Vector3<f64>, u32)> =
        lights.flat_map(|(at, _)| [(at, 0), (at + Vector3::new(0.1, 0.0, -0.15), 1)]).collect();
    let mut scene = confused_street(&both);
    let said: Vec<u32> = (0..scene.rays.rays.len() as u32).map(|ray| class_of(&scene, &both, ray)).collect();
    let rays = Arc::make_mut(&mut scene.rays);
    // Lights are missed instead of taken for signs: what is seen there is the sign beside them.
    for (ray, (was, is)) in rays.rays.iter_mut().zip(rays.class.iter().zip(&said)) {
        if was != is {
            ray.residual_from_world.fill(f64::NAN);
        }
    }
    rays.class = said;
    assert!(!calibrated(&scene).confusions.is_any());
}
