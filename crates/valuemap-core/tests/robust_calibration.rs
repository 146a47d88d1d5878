//! The noise is sought from starts that differ, but from none so large that it cannot be likelier.

#![allow(clippy::unwrap_used)]

mod street;

use nalgebra::{Isometry3, Vector3};
use street::{NOISE, SETTINGS, joined, moved, street};
use valuemap_core::progress::Progress;
use valuemap_core::robust::calibrate::{Known, Placed, calibrate};
use valuemap_core::robust::noise::Noise;
use valuemap_core::robust::sample::scramble;
use valuemap_core::robust::{Calibration, self_calibrate};

/// The sum of twelve uniform numbers less 6 is as good as normal.
fn normal(number: u64) -> f64 {
    let uniform = |number: u64| scramble(number) as f64 / u64::MAX as f64;
    (0..12).map(|part| uniform(12 * number + part)).sum::<f64>() - 6.0
}

/// What is estimated of a street whose detections are off by a standard deviation, beginning with 1 px.
fn calibrated(sigma_px: f64) -> Calibration {
    let objects: Vec<Vector3<f64>> =
        (0..12).map(|i| Vector3::new(25.0 + 9.0 * f64::from(i), if i % 2 == 0 { 5.0 } else { -6.0 }, 3.0)).collect();
    let errors: Vec<[f64; 2]> = (0..997).map(|i| [2 * i, 2 * i + 1].map(|number| sigma_px * normal(number))).collect();
    let scene = street(120, 1.0, &objects, &errors);
    self_calibrate(&scene, &NOISE, Known::default(), &SETTINGS, false, &Progress::default()).unwrap()
}

fn far_px(calibration: &Calibration) -> f64 {
    let noise = &calibration.noise;
    noise.detection_px.hypot(noise.rotation_rad * street::FOCAL_PX)
}

#[test]
fn where_all_fits_a_noise_many_times_as_large_is_not_tried() {
    let found = calibrated(1.0);
    assert!((0.7..1.4).contains(&far_px(&found)), "{:?}", found.noise);
    assert!(found.starts < 5, "{}", found.starts);
}

#[test]
fn where_little_fits_it_is_tried_and_found() {
    let found = calibrated(10.0);
    assert!((6.0..14.0).contains(&far_px(&found)), "{:?}", found.noise);
    assert!(found.starts > calibrated(1.0).starts, "{}", found.starts);
}

/// How far passes drift, each axis, m, as it is estimated from the true votes of objects of a street; but for some, of which every other pass
/// sees the next object.
fn drift_m(wrong: usize) -> f64 {
    let objects: Vec<Vector3<f64>> = (0..20).map(|i| Vector3::new(25.0 + 9.0 * f64::from(i), 5.0, 3.0)).collect();
    let errors: Vec<[f64; 2]> = (0..997).map(|i| [normal(2 * i), normal(2 * i + 1)]).collect();
    let shift = |pass: u64| Vector3::from_fn(|axis, _| 0.15 * normal(5000 + 3 * pass + axis as u64));
    // One object at a time, so that it is known whose rays are whose.
    let of_pass = |pass: u64, object: &Vector3<f64>| {
        moved(
            street(220, 1.0, &[*object], &errors),
            &Isometry3::translation(shift(pass).x, shift(pass).y, shift(pass).z),
        )
    };
    let parts: Vec<_> = objects.iter().flat_map(|object| (0..6).map(move |pass| (pass, object))).collect();
    let mut scene = joined(parts.iter().map(|&(pass, object)| of_pass(pass, object)).collect());
    for view in &mut scene.views {
        view.pass %= 6;
    }
    let mut labels: Vec<Placed> = objects.iter().map(|&object| (Vec::new(), object)).collect();
    for (ray, &image) in scene.rays.image.iter().enumerate() {
        let (object, pass) = (image as usize / 220 / 6, image as usize / 220 % 6);
        let is_wrong = object < wrong && pass % 2 == 1;
        labels[if is_wrong { (object + 1) % wrong } else { object }].0.push(ray as u32);
    }
    let guess = Noise { position_drift_m: 0.1, position_segment_m: 0.03, ..NOISE };
    calibrate(&scene, &guess, &labels, Known::default()).position_drift_m
}

#[test]
fn a_few_labels_of_two_objects_say_nothing_about_how_far_passes_drift() {
    let (of_right, of_some_wrong) = (drift_m(0), drift_m(5));
    assert!((0.08..0.25).contains(&of_right), "{of_right}");
    assert!((0.6..1.5).contains(&(of_some_wrong / of_right)), "{of_right} {of_some_wrong}");
}
