//! Things of which each side shows another middle, seen by drives from both ends of a street.

use std::f64::consts::PI;

use crate::robust::energy::estimate::{Care, Estimate, Joint, Start};
use crate::robust::energy::{fit, unseen};
use crate::robust::model::Model;
use crate::robust::noise::Noise;
use crate::robust::scene::Scene;
use nalgebra::{Isometry3, Matrix3, Point3, Vector3};

use crate::street::{NOISE, SETTINGS, joined, moved, street};

const SIDE_M: f64 = 0.3;
/// Poses that are known well, and sides that differ.
const SIDED: Noise = Noise { position_drift_m: 0.02, side_m: SIDE_M, ..NOISE };
const MIDDLE: Vector3<f64> = Vector3::new(60.0, 5.0, 3.0);

/// What two drives from each end see of an object that shows a middle of its own to each; the middle as seen from the near end comes first.
fn from_both_ends() -> (Scene, [Vector3<f64>; 2]) {
    let middles = [MIDDLE + Vector3::new(0.0, 0.3, -0.2), MIDDLE - Vector3::new(0.0, 0.3, -0.2)];
    let errors: Vec<[f64; 2]> = (0..97).map(|i| [(f64::from(i) * 1.7).sin(), (f64::from(i) * 2.3).cos()]).collect();
    let back = Isometry3::new(Vector3::new(120.0, 0.0, 0.0), Vector3::new(0.0, 0.0, PI));
    let drive = |number: usize| {
        let there = if number.is_multiple_of(2) { Isometry3::identity() } else { back };
        let seen = there.inverse() * Point3::from(middles[number % 2]);
        moved(street(60, 1.0, &[seen.coords], &errors[7 * number..]), &there)
    };
    (joined((0..4).map(drive).collect()), middles)
}

fn together(scene: &Scene, noise: &Noise, care: Care) -> Estimate {
    let rays = scene.usable_rays();
    let start = Start { voters: &rays, weights: &[], point: MIDDLE };
    Joint::new(scene, noise, std::iter::once(start), care).solve().unwrap().estimates[0]
}

#[test]
fn an_object_is_where_its_sides_put_it_and_known_no_better_than_they_agree() {
    let (scene, _) = from_both_ends();
    let model = Model::new(&scene, &SIDED, &SETTINGS);
    let found = fit(&model, &scene.usable_rays(), MIDDLE).unwrap();
    assert!((found.point - MIDDLE).norm() < 0.1, "{:?}", found.point);
    let sigmas_m = found.covariance.diagonal().map(f64::sqrt);
    let of_two_sides_m = SIDE_M / 2.0_f64.sqrt();
    assert!(sigmas_m.iter().all(|sigma_m| (0.99..1.2).contains(&(sigma_m / of_two_sides_m))), "{sigmas_m:?}");
    let as_one = Noise { side_m: 0.0, ..SIDED };
    let without = fit(&Model::new(&scene, &as_one, &SETTINGS), &scene.usable_rays(), MIDDLE).unwrap();
    assert!(without.covariance.trace() < 0.1 * found.covariance.trace());
}

#[test]
fn joint_estimates_know_of_middles_as_fits_do() {
    let (scene, _) = from_both_ends();
    let model = Model::new(&scene, &SIDED, &SETTINGS);
    let found = fit(&model, &scene.usable_rays(), MIDDLE).unwrap();
    for care in [Care::Rough, Care::Exact] {
        let Estimate { point, covariance } = together(&scene, &SIDED, care);
        let apart = found.covariance.cholesky().unwrap().l().solve_lower_triangular(&(point - found.point)).unwrap();
        assert!(apart.norm() < 0.1, "{care:?}: {apart:?}");
        let ratio = covariance * found.covariance.try_inverse().unwrap();
        assert!((ratio - Matrix3::identity()).norm() < 0.1, "{care:?}: {ratio}");
    }
}

#[test]
fn each_side_shows_its_own_middle() {
    let (scene, middles) = from_both_ends();
    let model = Model::new(&scene, &SIDED, &SETTINGS);
    let found = fit(&model, &scene.usable_rays(), MIDDLE).unwrap();
    for (middle, away) in middles.iter().zip([Vector3::x(), -Vector3::x()]) {
        let (seen, covariance) = found.seen_along(&away);
        assert!((seen - middle).norm() < 0.15, "{seen:?} instead of {middle:?}");
        // What a side shows is known better than where the middle of all sides is.
        assert!(covariance.trace() < 0.2 * found.covariance.trace());
    }
}

#[test]
fn two_sides_are_one_object_if_middles_may_differ_and_two_if_not() {
    let (scene, middles) = from_both_ends();
    let rays = scene.usable_rays();
    let of_side = |side: usize| -> Vec<u32> {
        rays.iter().copied().filter(|&ray| scene.view(ray).pass as usize % 2 == side).collect()
    };
    for (noise, is_one) in [(SIDED, true), (Noise { side_m: 0.0, ..SIDED }, false)] {
        let model = Model::new(&scene, &noise, &SETTINGS);
        let one = unseen(&model, rays.clone(), MIDDLE).unwrap().energy;
        let two: f64 = (0..2).map(|side| unseen(&model, of_side(side), middles[side]).unwrap().energy).sum();
        assert_eq!(one < two, is_one, "{one} and {two}");
    }
}

#[test]
fn where_each_visit_but_one_puts_a_side_is_where_that_side_is() {
    let (scene, middles) = from_both_ends();
    let rays = scene.usable_rays();
    let start = Start { voters: &rays, weights: &[], point: MIDDLE };
    let solution = Joint::new(&scene, &SIDED, std::iter::once(start), Care::Rough).solve().unwrap();
    let elsewhere = &solution.elsewhere()[0];
    assert_eq!(elsewhere.len(), 4);
    for one in elsewhere {
        let middle = middles[one.pass as usize % 2];
        assert!((one.estimate.point - middle).norm() < 0.2, "{one:?} instead of {middle:?}");
    }
}
