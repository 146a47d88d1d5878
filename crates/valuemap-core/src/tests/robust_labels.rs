//! Labels of a part of the images, and votes that might be a neighbor's, on random streets.

use std::collections::BTreeSet;

use crate::robust::energy::estimate::{Care, Joint, Limits, Start};
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::object as object_of;
use crate::robust::finish::contest::Contest;
use crate::robust::initial::keyframes::Keyframes;
use crate::robust::initial::label::{Label, from_voters};
use crate::robust::model::Model;
use crate::robust::noise::Noise;
use crate::robust::scene::{Scene, View};
use nalgebra::Vector3;
use proptest::collection::vec;
use proptest::prelude::*;

use crate::street::{GATE_SIGMAS, NOISE, SETTINGS, config, errors_px, object, street};

const DRIFTING: Noise = Noise { position_drift_m: 0.05, rotation_drift_rad: 5e-4, ..NOISE };

fn label(scene: &Scene, voters: Vec<u32>, start: Vector3<f64>) -> Label {
    from_voters(scene, &DRIFTING, GATE_SIGMAS, voters, start).unwrap()
}

/// The rays of one of some objects, each of which every image within range shows.
fn rays_of(scene: &Scene, object: &Vector3<f64>) -> Vec<u32> {
    let shows = |&ray: &u32| scene.ray(ray).squared_error(object) < 4.0_f64.powi(2);
    (0..scene.rays.rays.len() as u32).filter(shows).collect()
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn keyframes_are_one_image_of_each_stretch_and_camera(
        objects in vec(object(), 1..6), errors in errors_px(), stretch_m in 1.0..20.0_f64
    ) {
        let mut scene = street(60, 2.0, &objects, &errors);
        for (i, view) in scene.views.iter_mut().enumerate() {
            view.camera = i as u32 % 2;
            view.pass = i as u32 / 30;
        }
        prop_assert!(Keyframes::of(&scene).is_none());
        let keyframes = Keyframes::every(&scene, stretch_m);
        let stretch_of = |view: &View| {
            (view.pass, view.camera, (view.driven_m / stretch_m).floor() as i64)
        };
        let all: BTreeSet<_> = scene.views.iter().map(stretch_of).collect();
        let kept: BTreeSet<_> = keyframes.scene.views.iter().map(stretch_of).collect();
        prop_assert_eq!(keyframes.scene.views.len(), kept.len());
        prop_assert_eq!(kept, all);
        // A label of theirs rests on the same rays of the same images in the whole scene.
        let voters = rays_of(&keyframes.scene, &objects[0]);
        prop_assume!(voters.len() >= 3);
        let part = label(&keyframes.scene, voters, objects[0]);
        let whole = keyframes.in_whole(part.clone());
        prop_assert_eq!(whole.voters.len(), part.voters.len());
        for (&of_whole, &of_part) in whole.voters.iter().zip(&part.voters) {
            prop_assert_eq!(scene.ray(of_whole), keyframes.scene.ray(of_part));
            prop_assert_eq!(scene.view(of_whole).center, keyframes.scene.view(of_part).center);
        }
    }

    #[test]
    fn an_estimate_without_some_votes_is_the_one_that_never_had_them(
        object in object(), errors in errors_px(), every in 3..7_usize
    ) {
        let scene = street(70, 2.0, &[object], &errors);
        let voters: Vec<u32> = (0..scene.rays.rays.len() as u32).collect();
        let solve = |voters: &[u32]| {
            let start = Start { voters, weights: &[], point: object };
            Joint::new(&scene, &DRIFTING, std::iter::once(start), Care::Exact).solve().unwrap()
        };
        let solution = solve(&voters);
        let leaves: Vec<bool> = (0..voters.len()).map(|i| i % every == 0).collect();
        let found = solution.without(&leaves).unwrap()[0];
        let rest: Vec<u32> = voters.iter().zip(&leaves).filter(|(_, leaves)| !**leaves).map(|(ray, _)| *ray).collect();
        let expected = solve(&rest).estimates[0];
        let apart = found.point - expected.point;
        let sigmas2 = apart.dot(&expected.covariance.cholesky().unwrap().solve(&apart));
        prop_assert!(sigmas2 < 0.2_f64.powi(2), "{} sigmas", sigmas2.sqrt());
        prop_assert!((found.covariance - expected.covariance).norm() < 0.1 * expected.covariance.norm());
    }

    #[test]
    fn votes_are_contested_where_a_neighbor_is_not_shown_and_might_have_them(
        object in object(), errors in errors_px(), apart_m in 0.2..2.0_f64
    ) {
        let twin = object + Vector3::y() * apart_m;
        let scene = street(70, 2.0, &[object, twin], &errors);
        let (of_object, of_twin): (Vec<u32>, Vec<u32>) =
            (0..scene.rays.rays.len() as u32).partition(|ray| ray.is_multiple_of(2));
        prop_assume!(of_object.len() >= 8);
        // The twin is seen in the later half of the images alone.
        let of_twin = of_twin[of_twin.len() / 2..].to_vec();
        let model = Model::new(&scene, &DRIFTING, &SETTINGS);
        let lookout = Lookout::new(&scene, 60.0);
        let labels = [(of_object, object), (of_twin, twin)]
            .map(|(votes, point)| object_of(&model, &lookout, votes, point).unwrap());
        let starts = labels.iter().map(|label| Start { voters: &label.votes, weights: &[], point: label.fit.point });
        let solution = Joint::new(&scene, &DRIFTING, starts, Care::Exact).solve().unwrap();
        let contested = Contest::new(&model, &labels).contested(&solution);
        let shows_twin: BTreeSet<u32> = labels[1].votes.iter().map(|&ray| scene.rays.image[ray as usize]).collect();
        for (&(of, ray), is_contested) in solution.votes().iter().zip(contested) {
            let seen = scene.ray(ray);
            let projected = seen.project(&labels[1].fit.point);
            let variance = DRIFTING.total(&scene, ray).variance(projected.z);
            let fits = seen.squared_error(&labels[1].fit.point) / variance < GATE_SIGMAS * GATE_SIGMAS;
            let is_alone = !shows_twin.contains(&scene.rays.image[ray as usize]);
            prop_assert_eq!(is_contested, of == 0 && is_alone && fits);
        }
    }
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn votes_that_do_not_fit_leave_and_the_rest_decides(object in object(), errors in errors_px(), off_m in 3.0..6.0_f64) {
        let scene = street(70, 2.0, &[object, object + Vector3::z() * off_m], &errors);
        let good = rays_of(&scene, &object);
        let bad: Vec<u32> = (0..scene.rays.rays.len() as u32).filter(|ray| !good.contains(ray)).collect();
        prop_assume!(good.len() >= 10 && bad.len() > good.len() / 10);
        let bad = &bad[..=good.len() / 10];
        let limits = Limits { gate_sigmas: GATE_SIGMAS, min_votes: 3 };
        let all: Vec<u32> = good.iter().chain(bad).copied().collect();
        // Of the second label too few votes are left.
        let lost = [good[0], good[1], bad[0]];
        let starts = [&all[..], &lost].map(|voters| Start { voters, weights: &[], point: object });
        let found = Joint::new(&scene, &DRIFTING, starts.into_iter(), Care::Rough).solve_within(&limits).unwrap();
        let start = Start { voters: &good, weights: &[], point: object };
        let expected = Joint::new(&scene, &DRIFTING, std::iter::once(start), Care::Rough).solve_within(&limits).unwrap();
        prop_assert!(expected.refused.is_empty());
        prop_assert_eq!(found.votes(), expected.votes());
        let refused: BTreeSet<(usize, u32)> = found.refused.iter().copied().collect();
        let left = bad.iter().map(|&ray| (0, ray)).chain(lost.map(|ray| (1, ray)));
        prop_assert_eq!(refused, left.collect::<BTreeSet<_>>());
        let apart = found.estimates[0].point - expected.estimates[0].point;
        let sigmas2 = apart.dot(&expected.estimates[0].covariance.cholesky().unwrap().solve(&apart));
        prop_assert!(sigmas2 < 0.2_f64.powi(2), "{} sigmas", sigmas2.sqrt());
    }
}

#[test]
fn a_large_scene_has_keyframes_if_they_are_much_less() {
    let objects: Vec<Vector3<f64>> = (0..60).map(|i| Vector3::new(34.0, 4.0, 1.0 + 0.1 * f64::from(i))).collect();
    let dense = street(3000, 0.01, &objects, &[[0.0, 0.0]]);
    assert!(dense.rays.rays.len() >= 100_000);
    let keyframes = Keyframes::of(&dense).unwrap();
    assert_eq!(keyframes.scene.views.len(), 8);
    let mut sparse = dense;
    for (i, view) in sparse.views.iter_mut().enumerate() {
        view.driven_m = 10.0 * i as f64;
    }
    assert!(Keyframes::of(&sparse).is_none());
}
