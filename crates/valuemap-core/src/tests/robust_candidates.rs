//! How the robust method finds candidates, against the same thing done the slow way, on random streets.

use std::collections::BTreeMap;
use std::collections::BTreeSet;
use std::sync::Arc;

use crate::progress::Progress;
use crate::robust::energy::estimate::{Care, Estimate, Joint, Start};
use crate::robust::initial::adjust::adjust;
use crate::robust::initial::associate::Association;
use crate::robust::initial::gather::gather;
use crate::robust::initial::label::Label;
use crate::robust::model::{Model, VOTE_RANGE};
use crate::robust::noise::Noise;
use crate::robust::noise::index::{RayIndex, chi2};
use crate::robust::noise::spreads_of;
use crate::robust::scene::Scene;
use crate::robust::scene::sample::{Sampler, level_of};
use crate::robust::search::propose::{Who, propose};
use crate::robust::search::quick::quick_estimate;
use crate::robust::settings::Settings;
use crate::viability::Viability;
use nalgebra::{Rotation3, Vector3};
use proptest::collection::vec;
use proptest::prelude::*;

use crate::street::{GATE_SIGMAS, NOISE, SETTINGS, config, errors_px, joined, object, street};

proptest! {
    #![proptest_config(config())]

    #[test]
    fn the_index_finds_the_rays_that_a_look_at_all_of_them_finds(
        objects in vec(object(), 1..12), errors in errors_px(), points in vec(object(), 1..20), range_m in 10.0..80.0_f64
    ) {
        let mut scene = street(60, 2.0, &objects, &errors);
        let count = scene.rays.rays.len() as u32;
        for ray in 0..count {
            Arc::make_mut(&mut scene.rays).class[ray as usize] = ray % 3 / 2;
        }
        let spreads = spreads_of(&scene, &NOISE);
        let index = RayIndex::new(&scene, &spreads, GATE_SIGMAS, 0..count);
        for point in points.iter().chain(&objects) {
            let fit = |ray: u32| {
                let projected = scene.ray(ray).project(point);
                let near = (point - scene.ray(ray).center).norm() <= range_m;
                let chi2 = chi2(&projected, &spreads[ray as usize]);
                (near && projected.z > 0.0 && chi2 < GATE_SIGMAS * GATE_SIGMAS).then_some(chi2)
            };
            for class in [0, 1] {
                let seen = (0..count).filter(|&ray| scene.rays.class[ray as usize] == class && fit(ray).is_some());
                let mut found: Vec<u32> = index.all_hits(point, class, range_m).iter().map(|hit| hit.ray).collect();
                found.sort_unstable();
                prop_assert_eq!(found, seen.clone().collect::<Vec<_>>());
                let keep = |ray: u32| !ray.is_multiple_of(5);
                let mut closest: Vec<u32> = Vec::new();
                for ray in seen.filter(|&ray| keep(ray)) {
                    match closest.last_mut() {
                        Some(last) if scene.rays.image[*last as usize] == scene.rays.image[ray as usize] => {
                            if fit(ray) < fit(*last) {
                                *last = ray;
                            }
                        }
                        _ => closest.push(ray),
                    }
                }
                let hits = index.hits(point, class, range_m, &keep);
                prop_assert_eq!(hits.iter().map(|hit| hit.ray).collect::<Vec<_>>(), closest);
            }
        }
    }

    #[test]
    fn what_some_points_hit_is_what_any_of_them_does(
        objects in vec(object(), 1..6), errors in errors_px(), points in vec(object(), 1..6), apart_m in 0.0..200.0_f64,
        range_m in 10.0..80.0_f64
    ) {
        let scene = street(60, 2.0, &objects, &errors);
        let spreads = spreads_of(&scene, &NOISE);
        let index = RayIndex::new(&scene, &spreads, GATE_SIGMAS, 0..scene.rays.rays.len() as u32);
        let spread_out = points.iter().enumerate().map(|(i, point)| point + Vector3::x() * (apart_m * i as f64));
        let points: Vec<Vector3<f64>> = spread_out.chain(objects).collect();
        let mut nearest: BTreeMap<u32, f64> = BTreeMap::new();
        for hit in points.iter().flat_map(|point| index.all_hits(point, 0, range_m)) {
            let chi2 = nearest.entry(hit.ray).or_insert(hit.chi2);
            *chi2 = chi2.min(hit.chi2);
        }
        let found: BTreeMap<u32, f64> =
            index.hits_of_any(&points, &|class| class == 0, range_m).iter().map(|hit| (hit.ray, hit.chi2)).collect();
        prop_assert_eq!(found, nearest);
    }

    #[test]
    fn every_image_proposes_where_its_object_is(object in object(), errors in errors_px()) {
        let scene = street(70, 2.0, &[object], &errors);
        let model = Model::new(&scene, &NOISE, &SETTINGS);
        let free: Vec<u32> = (0..scene.rays.rays.len() as u32).collect();
        let of = |who| propose(&model, &free, who, &Progress::default()).unwrap();
        let all = of(Who::All);
        prop_assert!(all.len() as f64 > 0.9 * free.len() as f64, "{} of {}", all.len(), free.len());
        for hypothesis in &all {
            let [a, b] = hypothesis.rays.map(|ray| scene.ray(ray));
            prop_assert!(a.center != b.center);
            prop_assert!((hypothesis.point - object).norm() < 0.15 * (hypothesis.point - a.center).norm());
            prop_assert!(hypothesis.support > 1.0);
        }
        let best = *all.iter().max_by(|a, b| a.support.total_cmp(&b.support)).unwrap();
        prop_assert!((best.point - object).norm() < 0.5, "{}", (best.point - object).norm());
        // So few images all propose.
        prop_assert_eq!(of(Who::Part), all);
    }

    #[test]
    fn rays_meet_as_far_away_as_detections_vote(errors in errors_px()) {
        // From 47 to 29 m away; from two images it is within 32 m, from one within 30 m.
        let scene = street(10, 2.0, &[Vector3::new(46.0, 8.0, 3.0)], &errors);
        let meet = |reach_m: f64| {
            let viability = Viability { max_range_m: reach_m / VOTE_RANGE, ..SETTINGS.viability };
            let settings = Settings { viability, ..SETTINGS };
            let model = Model::new(&scene, &NOISE, &settings);
            let all = propose(&model, &scene.usable_rays(), Who::All, &Progress::default()).unwrap();
            all.iter().any(|hypothesis| hypothesis.rays[0] != hypothesis.rays[1])
        };
        prop_assert!(meet(45.0) && !meet(30.0));
    }

    #[test]
    fn a_ray_speaks_less_for_a_point_that_is_not_as_far_away_as_measured(object in object(), errors in errors_px()) {
        let mut scene = street(70, 2.0, &[object], &errors);
        let count = scene.rays.rays.len() as u32;
        scene.range_m = (0..count).map(|ray| (scene.ray(ray).center - object).norm()).collect();
        scene.range_sigma_m = vec![1.0; count as usize];
        let support = |scene: &Scene, ray: u32| {
            let model = Model::new(scene, &NOISE, &SETTINGS);
            let all = propose(&model, &scene.usable_rays(), Who::All, &Progress::default()).unwrap();
            all.into_iter().find(|hypothesis| hypothesis.rays[0] == ray).map(|hypothesis| hypothesis.support)
        };
        let ray = count / 2;
        let Some(given) = support(&scene, ray) else { return Ok(()) };
        scene.range_m[ray as usize] *= 3.0;
        prop_assert!(support(&scene, ray).is_none_or(|wrong| wrong < given - 1.0));
    }

}

proptest! {
    #![proptest_config(ProptestConfig { cases: 4, ..config() })]

    #[test]
    fn where_there_are_many_images_a_part_of_them_proposes(object in object(), errors in errors_px()) {
        let scene = street(3000, 0.05, &[object], &errors);
        let model = Model::new(&scene, &NOISE, &SETTINGS);
        let free: Vec<u32> = (0..scene.rays.rays.len() as u32).collect();
        let of = |who| propose(&model, &free, who, &Progress::default()).unwrap();
        let (all, part) = (of(Who::All), of(Who::Part));
        prop_assert!(part.len() < all.len() && part.len() >= 20, "{} of {}", part.len(), all.len());
        let level = part.iter().map(|one| level_of(scene.rays.image[one.rays[0] as usize])).min().unwrap();
        prop_assert!(level >= 1);
        let of_images = all.into_iter().filter(|one| level_of(scene.rays.image[one.rays[0] as usize]) >= level);
        prop_assert_eq!(part, of_images.collect::<Vec<_>>());
    }

}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn a_quick_estimate_is_nearly_the_exact_one(object in object(), errors in errors_px(), x in -1.0..1.0, y in -0.3..0.3) {
        let scene = street(70, 2.0, &[object], &errors);
        let spreads = spreads_of(&scene, &NOISE);
        let voters: Vec<u32> = (0..scene.rays.rays.len() as u32).collect();
        let start = object + Vector3::new(x, y, 0.2);
        let quick = quick_estimate(&scene, &spreads, &voters, start).unwrap();
        let exact = estimate(&scene, &NOISE, &voters, start, Care::Exact).unwrap();
        let apart = quick - exact.point;
        let sigmas2 = apart.dot(&exact.covariance.cholesky().unwrap().solve(&apart));
        prop_assert!(sigmas2 < 0.3_f64.powi(2), "{} m, {} sigmas", apart.norm(), sigmas2.sqrt());
    }

    #[test]
    fn a_sample_is_bounded_and_the_same_in_any_frame(
        places in vec([-100.0..100.0, -100.0..100.0, -3.0..3.0], 2..400), most in 1..60_usize,
        turn in -3.0..3.0_f64, shift in [-1e3..1e3, -1e3..1e3, -10.0..10.0]
    ) {
        const RADIUS_M: f64 = 60.0;
        let centers: Vec<Vector3<f64>> = places.into_iter().map(Vector3::from).collect();
        let turn = Rotation3::from_euler_angles(0.1, 0.2, turn);
        let moved: Vec<Vector3<f64>> = centers.iter().map(|center| turn * center + Vector3::from(shift)).collect();
        let images: Vec<u32> = (0..centers.len() as u32).filter(|image| image % 7 != 3).collect();
        let (here, there) = (Sampler::new(&centers, &images, RADIUS_M), Sampler::new(&moved, &images, RADIUS_M));
        for &image in &images {
            let distance = |other: u32| (centers[other as usize] - centers[image as usize]).norm();
            let near = images.iter().filter(|&&other| distance(other) <= RADIUS_M && distance(other) > 0.0);
            let sample = here.around(image, most);
            prop_assert_eq!(&sample, &there.around(image, most));
            let found: BTreeSet<u32> = sample.iter().copied().collect();
            prop_assert_eq!(sample.len(), found.len());
            prop_assert_eq!(sample.len(), near.clone().count().min(most));
            prop_assert!(found.is_subset(&near.copied().collect()));
        }
    }
}

/// The voters of labels, each in one order.
fn voters(labels: &[Label]) -> BTreeSet<Vec<u32>> {
    labels.iter().map(|label| label.voters.iter().copied().collect::<BTreeSet<_>>().into_iter().collect()).collect()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 5, ..config() })]

    #[test]
    fn what_is_decided_only_where_labels_changed_is_what_is_decided_anew(
        objects in vec(object(), 2..7), errors in errors_px()
    ) {
        // Each object has a twin, so that there is something to decide.
        let twins = objects.iter().map(|object| object + Vector3::y() * 0.5);
        let objects: Vec<Vector3<f64>> = objects.iter().copied().chain(twins).collect();
        let scene = street(70, 2.0, &objects, &errors);
        let noise = Noise { position_drift_m: 0.03, rotation_drift_rad: 5e-4, ..NOISE };
        let progress = Progress::default();
        let all = 0..scene.rays.rays.len() as u32;
        let spreads = spreads_of(&scene, &noise);
        let begin = || {
            let index = RayIndex::new(&scene, &spreads, GATE_SIGMAS, all.clone());
            Association::new(&scene, &noise, index, 150.0)
        };
        let rays: Vec<u32> = all.clone().collect();
        let model = Model::new(&scene, &noise, &SETTINGS);
        let (mut labels, _) = gather(&model, &rays, &progress).unwrap();
        let mut with_memory = begin();
        for _ in 0..6 {
            let given = with_memory.associate(labels.clone(), &progress).unwrap();
            prop_assert_eq!(voters(&given), voters(&begin().associate(labels, &progress).unwrap()));
            let enough: Vec<Label> = given.into_iter().filter(|label| label.voters.len() >= 3).collect();
            labels = adjust(&model, &enough, &progress).unwrap();
        }
        prop_assert!(!labels.is_empty());
    }
}

/// A scene in which an object 30 m along a street is seen from its first 9 m, and one more image looks along the street from `ahead_m` before it.
fn with_image_at(object: Vector3<f64>, ahead_m: f64) -> Scene {
    let mut there = street(1, 1.0, &[object], &[[0.0; 2]]);
    let center = object - Vector3::x() * ahead_m;
    Arc::make_mut(&mut there.rays).rays[0].center = center;
    there.views[0].center = center;
    joined(vec![street(10, 1.0, &[object], &[[0.3, -0.2]]), there])
}

/// The position of one label from its voters, starting nearby.
fn estimate(scene: &Scene, noise: &Noise, voters: &[u32], start: Vector3<f64>, care: Care) -> Option<Estimate> {
    let start = Start { voters, weights: &[], point: start };
    Joint::new(scene, noise, std::iter::once(start), care).solve()?.estimates.pop()
}

#[test]
fn no_step_of_an_estimate_leads_behind_a_voter() {
    let object = Vector3::new(30.0, 2.0, 3.0);
    // The last image has passed it.
    let scene = with_image_at(object, -2.0);
    let noise = Noise { position_m: 0.5, ..NOISE };
    let spreads = spreads_of(&scene, &noise);
    let voters: Vec<u32> = (0..scene.rays.rays.len() as u32).collect();
    let start = object + Vector3::new(4.0, 0.2, 0.3);
    let quick = quick_estimate(&scene, &spreads, &voters, start).unwrap();
    let rough = estimate(&scene, &noise, &voters, start, Care::Rough).unwrap().point;
    assert!(quick.x > 32.0 && rough.x > 32.0, "{quick} {rough}");
}

#[test]
fn cameras_that_may_be_beyond_the_object_do_not_vote_for_it() {
    let object = Vector3::new(30.0, 2.0, 3.0);
    let mut scene = with_image_at(object, 0.5);
    scene.frusta[0].solid_angle_sr = 0.6;
    let noise = Noise { position_m: 0.5, ..NOISE };
    let rays: Vec<u32> = (0..scene.rays.rays.len() as u32).collect();
    let model = Model::new(&scene, &noise, &SETTINGS);
    let index = RayIndex::new(&scene, &model.spreads, GATE_SIGMAS, rays.iter().copied());
    let last = rays.len() as u32 - 1;
    assert!(index.all_hits(&object, 0, 100.0).iter().any(|hit| hit.ray == last));
    let (found, _) = gather(&model, &rays, &Progress::default()).unwrap();
    let voters: Vec<&u32> = found.iter().flat_map(|label| &label.voters).collect();
    assert!(voters.len() == 10 && !voters.contains(&&last), "{voters:?}");
}
