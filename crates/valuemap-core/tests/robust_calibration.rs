//! The noise is sought from starts that differ, but from none so large that it cannot be likelier.

#![allow(clippy::unwrap_used)]

mod street;

use nalgebra::Vector3;
use street::{NOISE, SETTINGS, street};
use valuemap_core::progress::Progress;
use valuemap_core::robust::calibrate::Known;
use valuemap_core::robust::sample::scramble;
use valuemap_core::robust::{Calibration, self_calibrate};

/// What is estimated of a street whose detections are off by a standard deviation, beginning with 1 px.
fn calibrated(sigma_px: f64) -> Calibration {
    let objects: Vec<Vector3<f64>> =
        (0..12).map(|i| Vector3::new(25.0 + 9.0 * f64::from(i), if i % 2 == 0 { 5.0 } else { -6.0 }, 3.0)).collect();
    // The sum of twelve uniform numbers less 6 is as good as normal.
    let uniform = |number: u64| scramble(number) as f64 / u64::MAX as f64;
    let normal = |number: u64| (0..12).map(|part| uniform(12 * number + part)).sum::<f64>() - 6.0;
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
