//! The noise is sought from starts that differ, but from none so large that it cannot be likelier.

use std::sync::Arc;

use crate::progress::Progress;
use crate::robust::calibrate::likeliest::misfits;
use crate::robust::calibrate::residuals::calibrate;
use crate::robust::calibrate::{CALIBRATION_STEPS, Calibration, self_calibrate};
use crate::robust::energy::Placed;
use crate::robust::energy::agreement::{disagreement, mean};
use crate::robust::noise::Known;
use crate::robust::noise::Noise;
use crate::robust::noise::spreads_of;
use crate::robust::scene::Scene;
use crate::robust::scene::sample::scramble;
use crate::robust::search::quick::quick_estimate;
use crate::street::{self, NOISE, SETTINGS, joined, moved, street};
use nalgebra::{Isometry3, Rotation3, Vector3};

/// The sum of twelve uniform numbers less 6 is as good as normal.
fn normal(number: u64) -> f64 {
    let uniform = |number: u64| scramble(number) as f64 / u64::MAX as f64;
    (0..12).map(|part| uniform(12 * number + part)).sum::<f64>() - 6.0
}

/// What is estimated of a street whose detections are off by a standard deviation, beginning with 1 px.
fn calibrated(sigma_px: f64) -> Calibration {
    calibrated_of_rounded(sigma_px, 0.0)
}

/// The same where detections are rounded, which they are off by at least.
fn calibrated_of_rounded(sigma_px: f64, least_px: f64) -> Calibration {
    calibrated_in_steps(sigma_px, least_px).0
}

/// The same, and in how many steps.
fn calibrated_in_steps(sigma_px: f64, least_px: f64) -> (Calibration, usize) {
    let (known, progress) = (Known { least_px, ..Known::default() }, Progress::default());
    let found = self_calibrate(&off_by(sigma_px), &NOISE, known, &SETTINGS, false, None, &progress).unwrap().0;
    (found, progress.done())
}

/// A street whose detections are off by a standard deviation.
fn off_by(sigma_px: f64) -> Scene {
    let objects: Vec<Vector3<f64>> =
        (0..12).map(|i| Vector3::new(25.0 + 9.0 * f64::from(i), if i % 2 == 0 { 5.0 } else { -6.0 }, 3.0)).collect();
    let errors: Vec<[f64; 2]> = (0..997).map(|i| [2 * i, 2 * i + 1].map(|number| sigma_px * normal(number))).collect();
    street(120, 1.0, &objects, &errors)
}

fn far_px(calibration: &Calibration) -> f64 {
    let noise = &calibration.noise;
    noise.detection_px.hypot(noise.rotation_rad * street::FOCAL_PX)
}

#[test]
fn where_all_fits_a_noise_many_times_as_large_is_not_tried() {
    let (found, steps) = calibrated_in_steps(1.0, 0.0);
    assert!((0.7..1.4).contains(&far_px(&found)), "{:?}", found.noise);
    assert!(steps < CALIBRATION_STEPS - 6, "{steps}");
}

#[test]
fn where_little_fits_it_is_tried_and_found() {
    let (found, steps) = calibrated_in_steps(10.0, 0.0);
    assert!((6.0..14.0).contains(&far_px(&found)), "{:?}", found.noise);
    assert!(steps > calibrated_in_steps(1.0, 0.0).1, "{steps}");
}

#[test]
fn one_drive_does_not_say_how_far_drives_are_off() {
    let guess = Noise { position_drift_m: 0.5, ..NOISE };
    let (known, progress) = (Known::default(), Progress::default());
    let found = self_calibrate(&off_by(1.0), &guess, known, &SETTINGS, false, None, &progress).unwrap().0;
    assert!((found.noise_of_covariances.position_drift_m - 0.5).abs() < 1e-9);
    assert!(found.noise.position_drift_m < 0.25, "{:?}", found.noise);
}

/// What is estimated of objects by a street each, whose successive detections have errors of 1 px with a correlation.
fn of_wandering(correlation: f64) -> Calibration {
    let of_object = |number: u64| {
        let mut errors: Vec<[f64; 2]> = Vec::new();
        for image in 0..40 {
            let new = [0, 1].map(|axis| normal(200 * number + 2 * image + axis));
            let fresh = (1.0 - correlation * correlation).sqrt();
            errors.push(
                errors.last().map_or(new, |last| [0, 1].map(|axis| correlation * last[axis] + fresh * new[axis])),
            );
        }
        street(40, 1.0, &[Vector3::new(42.0, if number.is_multiple_of(2) { 5.0 } else { -6.0 }, 3.0)], &errors)
    };
    let scene = joined((0..24).map(of_object).collect());
    self_calibrate(&scene, &NOISE, Known::default(), &SETTINGS, false, None, &Progress::default()).unwrap().0
}

#[test]
fn looks_that_remember_their_errors_count_as_fewer() {
    let independent = of_wandering(0.0).noise_of_covariances;
    assert!(independent.look_correlation < 0.2, "{independent:?}");
    let remembering = of_wandering(0.8).noise_of_covariances;
    assert!((0.6..0.95).contains(&remembering.look_correlation), "{remembering:?}");
}

/// Pins that few bearings which meet by chance are not more exact than they are written down.
#[test]
fn what_poses_were_compared_with_is_not_sought_again() {
    let scene = off_by(1.0);
    let numbers: Vec<u32> = (0..scene.rays.rays.len() as u32).collect();
    let with = |second: &Scene| {
        misfits([&scene, second], &numbers, &NOISE, Known::default(), &SETTINGS, &Progress::default()).unwrap().of_first
    };
    let calibrated = |sought: Option<Noise>, guess: &Noise| {
        self_calibrate(&scene, guess, Known::default(), &SETTINGS, false, sought, &Progress::default()).unwrap().0.noise
    };
    let sought = with(&scene).unwrap();
    assert_eq!(calibrated(Some(sought), &NOISE), calibrated(None, &NOISE));
    // It is taken as it is, unless middles were not known: then it is a start.
    let other = Noise { position_drift_m: 3.0 * sought.position_drift_m, ..sought };
    assert_ne!(calibrated(Some(other), &NOISE), calibrated(Some(sought), &NOISE));
    let with_sides = Noise { side_m: 0.05, ..NOISE };
    assert_eq!(calibrated(Some(other), &with_sides), calibrated(Some(sought), &with_sides));
    // Not where a ray that tells nothing in the second scene was left out.
    let mut without_one = scene.clone();
    Arc::make_mut(&mut without_one.rays).rays[0].center.x = f64::NAN;
    assert_eq!(with(&without_one), None);
}

#[test]
fn poses_that_state_large_errors_still_tell_how_small_those_of_single_images_are() {
    for stated_m in [0.5, 6.0] {
        let mut scene = joined(vec![off_by(1.0), moved(off_by(1.0), &Isometry3::translation(0.4, -0.3, 0.0))]);
        scene.views.iter_mut().for_each(|view| view.position_sigma_m = stated_m);
        let found =
            self_calibrate(&scene, &NOISE, Known::default(), &SETTINGS, false, None, &Progress::default()).unwrap().0;
        assert!((0.5..1.5).contains(&far_px(&found)), "{stated_m} m: {:?}", found.noise);
        assert!(found.noise.position_m < 0.1, "{stated_m} m: {:?}", found.noise);
        assert!((found.noise.position_drift_m / stated_m - 1.0).abs() < 0.05, "{stated_m} m: {:?}", found.noise);
    }
}

#[test]
fn noise_is_not_below_that_of_rounding() {
    assert!(far_px(&calibrated(0.5)) < 1.0);
    assert!(far_px(&calibrated_of_rounded(0.5, 3.0)) > 2.99);
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
    // Far from what it is, so that it does not stay.
    let guess = Noise { position_drift_m: 1.0, position_segment_m: 0.03, ..NOISE };
    calibrate(&scene, &guess, &labels, Known::default()).position_drift_m
}

#[test]
fn a_few_labels_of_two_objects_say_nothing_about_how_far_passes_drift() {
    let (of_right, of_some_wrong) = (drift_m(0), drift_m(5));
    assert!((0.08..0.25).contains(&of_right), "{of_right}");
    assert!((0.6..1.5).contains(&(of_some_wrong / of_right)), "{of_right} {of_some_wrong}");
}

/// Standard deviation of where images are said to be, each for itself, of [`from_two_sides`].
const OFF_M: f64 = 0.5;

/// Objects of a street and their true votes, seen on six drives in turn from either end by a camera whose positions are off.
fn from_two_sides() -> (Scene, Vec<Placed>) {
    let objects: Vec<Vector3<f64>> = (0..16).map(|i| Vector3::new(60.0 + 7.0 * f64::from(i), 6.0, 3.0)).collect();
    let errors: Vec<[f64; 2]> = (0..997).map(|i| [normal(2 * i), normal(2 * i + 1)]).collect();
    // Half a turn about the middle of the street.
    let back = Isometry3::new(Vector3::new(220.0, 0.0, 0.0), Vector3::new(0.0, 0.0, std::f64::consts::PI));
    let of_drive = |drive: u64, object: &Vector3<f64>| {
        let there = if drive.is_multiple_of(2) { Isometry3::identity() } else { back };
        moved(
            street(220, 1.0, &[there.inverse() * nalgebra::Point3::from(*object)].map(|at| at.coords), &errors),
            &there,
        )
    };
    let parts = objects.iter().flat_map(|object| (0..6).map(move |drive| (drive, object)));
    let mut scene = joined(parts.map(|(drive, object)| of_drive(drive, object)).collect());
    let mut labels: Vec<Placed> = objects.iter().map(|&object| (Vec::new(), object)).collect();
    let images = scene.rays.image.clone();
    for (ray, &image) in images.iter().enumerate() {
        let (votes, point) = &mut labels[image as usize / 220 / 6];
        // Nearer, the residuals of so wrong positions are far from linear.
        if scene.rays.rays[ray].project(point).z > 15.0 {
            votes.push(ray as u32);
        }
        let off = Vector3::from_fn(|axis, _| OFF_M * normal(9000 + 3 * u64::from(image) + axis as u64));
        Arc::make_mut(&mut scene.rays).rays[ray].center += off;
        scene.views[image as usize].center += off;
    }
    for view in &mut scene.views {
        view.pass %= 6;
    }
    (scene, labels)
}

#[test]
fn drives_from_two_sides_agree_however_wrong_positions_of_images_are() {
    let (scene, labels) = from_two_sides();
    let truth = Noise { position_m: OFF_M, position_drift_m: 0.05, ..NOISE };
    let disagreements = labels.iter().map(|label| disagreement(&scene, &truth, label)).collect();
    let of_mean = mean(disagreements).unwrap();
    assert!((0.7..1.3).contains(&of_mean), "{of_mean}");
}

#[test]
fn quick_estimates_from_one_side_are_off_to_neither() {
    let (scene, labels) = from_two_sides();
    let noise = Noise { position_m: OFF_M, ..NOISE };
    let spreads = spreads_of(&scene, &noise);
    let away_m = |(votes, point): &Placed| {
        let of_side: Vec<u32> = votes.iter().copied().filter(|&ray| scene.view(ray).pass.is_multiple_of(2)).collect();
        (quick_estimate(&scene, &spreads, &of_side, *point).unwrap() - point).x
    };
    let all: Vec<f64> = labels.iter().map(away_m).collect();
    let of_mean = all.iter().sum::<f64>() / all.len() as f64;
    let deviation = (all.iter().map(|one| (one - of_mean).powi(2)).sum::<f64>() / all.len() as f64).sqrt();
    assert!(of_mean.abs() < 3.0 * deviation / (all.len() as f64).sqrt(), "{of_mean} {deviation}");
}

#[test]
fn the_noise_of_positions_is_found_from_drives_of_two_sides() {
    let (scene, labels) = from_two_sides();
    for position_m in [0.15, 1.0] {
        let guess = Noise { position_m, position_segment_m: 0.03, rotation_segment_rad: 5e-4, ..NOISE };
        let found = calibrate(&scene, &guess, &labels, Known::default());
        assert!((0.9..1.1).contains(&(found.position_m / OFF_M)), "{found:?}");
        assert!(found.position_drift_m < 0.5 * OFF_M, "{found:?}");
    }
}

/// How far poses are off, each axis of each image, and boxes: either both errors of the poses or both of the boxes.
const OFF_SHARE: f64 = 0.1;
const OFF_RAD: f64 = 3e-3;

/// What is estimated of two drives past pairs of objects of 1 m, with errors that move a box of them as far, be they of poses or of boxes.
fn noise_of(are_of_poses: bool) -> Noise {
    let objects: Vec<Vector3<f64>> = (0..12)
        .map(|i| Vector3::new(25.0 + 12.0 * f64::from(i / 2), if i % 2 == 0 { 5.0 } else { -6.0 }, 3.0))
        .collect();
    let drive = |number: u64| {
        let of_axis = |part: u64, at: u64, axis: u64| normal((100 * number + part) * 10_000 + 3 * at + axis);
        let without = street(80, 1.0, &objects, &[[0.0, 0.0]]);
        let depth_m = |ray: &crate::ray::Ray| {
            objects.iter().map(|object| ray.project(object)).find(|at| at.x.hypot(at.y) < 1e-6 * at.z).unwrap().z
        };
        let depths: Vec<f64> = without.rays.rays.iter().map(depth_m).collect();
        let of_box = |(at, depth): (u64, &f64)| {
            let off_px = street::FOCAL_PX * OFF_RAD.hypot(OFF_SHARE / depth);
            [0, 1]
                .map(|axis| 0.5 * of_axis(0, at, axis) + if are_of_poses { 0.0 } else { off_px * of_axis(1, at, axis) })
        };
        let errors: Vec<[f64; 2]> = (0..).zip(&depths).map(of_box).collect();
        let mut scene = street(80, 1.0, &objects, &errors);
        scene.box_px = depths.iter().map(|depth| street::FOCAL_PX / depth).collect();
        if are_of_poses {
            let images = scene.rays.image.clone();
            let off = |image: u32| Vector3::from_fn(|axis, _| OFF_SHARE * of_axis(2, u64::from(image), axis as u64));
            let turn = |image: u32| {
                Rotation3::new(Vector3::from_fn(|axis, _| OFF_RAD * of_axis(3, u64::from(image), axis as u64)))
            };
            for (ray, image) in Arc::make_mut(&mut scene.rays).rays.iter_mut().zip(images) {
                ray.center += off(image);
                ray.residual_from_world *= turn(image).inverse();
                ray.direction = turn(image) * ray.direction;
            }
            for (image, view) in (0..).zip(&mut scene.views) {
                view.center += off(image);
                view.cam_from_world *= turn(image).inverse();
            }
        }
        scene
    };
    let scene = joined((0..2).map(drive).collect());
    let guess = Noise { box_share: 0.04, position_m: 0.1, ..NOISE };
    self_calibrate(&scene, &guess, Known::default(), &SETTINGS, false, None, &Progress::default()).unwrap().0.noise
}

#[test]
fn what_the_objects_of_an_image_have_in_common_is_its_poses_error() {
    // By how much more errors of poses move a box than its own, far away and nearby.
    let ratios = |noise: &Noise| {
        [street::FOCAL_PX * noise.rotation_rad / noise.detection_px, noise.position_m / noise.box_share]
    };
    let [of_poses, of_boxes] = [true, false].map(noise_of);
    assert!(ratios(&of_poses).iter().all(|ratio| *ratio > 3.0), "{of_poses:?}");
    assert!(ratios(&of_boxes).iter().all(|ratio| *ratio < 1.0 / 3.0), "{of_boxes:?}");
    assert!((0.7..1.3).contains(&(of_poses.position_m / OFF_SHARE)), "{of_poses:?}");
    assert!((0.7..1.3).contains(&(of_boxes.box_share / OFF_SHARE)), "{of_boxes:?}");
}
