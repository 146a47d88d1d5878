//! The energy J and the search for the map with the least of it, on small random streets.

use std::collections::BTreeSet;
use std::f64::consts::{FRAC_PI_2, PI};
use std::sync::Arc;

use crate::progress::Progress;
use crate::robust::energy::Placed;
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::seen::Looks;
use crate::robust::energy::{Object, fit, object as object_of};
use crate::robust::learn::learn;
use crate::robust::model::confusions::Confusions;
use crate::robust::model::{ClassModel, Model, VOTE_RANGE};
use crate::robust::noise::Noise;
use crate::robust::noise::index::RayIndex;
use crate::robust::scene::{Frustum, Scene};
use crate::robust::search::rearrange::{TriedPairs, rearrange_pairs};
use crate::robust::search::repair::repair;
use crate::robust::search::{Depth, search};
use crate::robust::settings::Settings;
use crate::viability::Viability;
use nalgebra::{Isometry3, Point3, Vector3};
use proptest::collection::vec;
use proptest::prelude::*;

use crate::street::{
    FOCAL_PX, GATE_SIGMAS, NOISE, SETTINGS, config, errors_px, joined, moved, object, objects_of, street,
};

/// What the streets' errors are.
const DRIFTING: Noise = Noise { position_drift_m: 0.05, rotation_drift_rad: 5e-4, ..NOISE };

fn few(cases: u32) -> ProptestConfig {
    ProptestConfig { cases, ..config() }
}

/// Where it is and what votes for it: each object with the rays that pass it more closely than all others.
fn truth(scene: &Scene, objects: &[Vector3<f64>]) -> Vec<Placed> {
    let mut votes = vec![Vec::new(); objects.len()];
    for ray in 0..scene.rays.rays.len() as u32 {
        let error = |i: &usize| scene.ray(ray).squared_error(&objects[*i]);
        let nearest = (0..objects.len()).min_by(|a, b| error(a).total_cmp(&error(b))).unwrap();
        votes[nearest].push(ray);
    }
    votes.into_iter().zip(objects).map(|(votes, &point)| (votes, point)).filter(|(votes, _)| votes.len() >= 3).collect()
}

/// Give each object's boxes the size that it has, m.
fn with_sizes(mut scene: Scene, objects: &[Vector3<f64>], sizes_m: &[f64]) -> Scene {
    for (i, (votes, point)) in truth(&scene, objects).into_iter().enumerate() {
        for ray in votes {
            scene.box_px[ray as usize] = FOCAL_PX * sizes_m[i] / scene.ray(ray).project(&point).z;
        }
    }
    scene
}

/// What some objects are with a noise, as they are or searched.
fn as_found(scene: &Scene, noise: &Noise, begun: Vec<Placed>, is_searched: bool) -> Vec<Object> {
    objects_of(scene, noise, &SETTINGS, begun, is_searched, &Progress::default()).unwrap()
}

fn energy(objects: &[Object]) -> f64 {
    objects.iter().map(|object| object.energy).sum()
}

fn placed(objects: &[Object]) -> Vec<Placed> {
    objects.iter().map(|object| (object.votes.clone(), object.fit.point)).collect()
}

fn votes(objects: &[Object]) -> BTreeSet<Vec<u32>> {
    objects.iter().map(|object| object.votes.clone()).collect()
}

fn as_it_is(scene: &Scene, begun: Vec<Placed>) -> Vec<Object> {
    as_found(scene, &DRIFTING, begun, false)
}

fn searched(scene: &Scene, begun: Vec<Placed>) -> Vec<Object> {
    as_found(scene, &DRIFTING, begun, true)
}

/// A model of a scene that has learned what some objects tell, with all that a move needs.
struct World<'a> {
    model: Model<'a>,
    lookout: Lookout,
    objects: Vec<Object>,
}

impl<'a> World<'a> {
    fn new(scene: &'a Scene, begun: &[Placed]) -> Self {
        let mut model = Model::new(scene, &DRIFTING, &SETTINGS);
        let lookout = Lookout::new(scene, SETTINGS.viability.max_range_m);
        let of = |model: &Model<'_>, begun: &[Placed]| -> Vec<Object> {
            let one = |(votes, point): &Placed| object_of(model, &lookout, votes.clone(), *point);
            begun.iter().filter_map(one).collect()
        };
        let objects = of(&model, begun);
        learn(&mut model, &lookout, &scene.usable_rays(), &objects);
        let objects = of(&model, begun);
        Self { model, lookout, objects }
    }

    fn index(&self) -> RayIndex<'_> {
        let rays = 0..self.model.scene.rays.rays.len() as u32;
        RayIndex::new(self.model.scene, &self.model.spreads, GATE_SIGMAS, rays)
    }

    fn rearranged(&self) -> Vec<Object> {
        let mut tried = TriedPairs::default();
        let (index, progress) = (self.index(), Progress::default());
        rearrange_pairs(&self.model, &self.lookout, &index, self.objects.clone(), &mut tried, &progress).unwrap().0
    }
}

/// Two objects that drives along x and along y see, twelve images each, from 12 to 40 m.
fn crossing(objects: [Vector3<f64>; 2], errors: &[[f64; 2]]) -> Scene {
    let turn = Isometry3::new(Vector3::new(objects[0].x, objects[0].y - 40.0, 0.0), Vector3::z() * FRAC_PI_2);
    let seen = objects.map(|object| (turn.inverse() * Point3::from(object)).coords);
    joined(vec![street(12, 2.5, &objects, errors), moved(street(12, 2.5, &seen, &errors[7..]), &turn)])
}

proptest! {
    #![proptest_config(few(8))]

    /// Pins that what is learned is stored in full, and that a class that nobody knows is like all others but for its clutter.
    #[test]
    fn what_is_learned_is_what_is_stored_of_it(objects in vec(object(), 5..7), errors in errors_px()) {
        let scene = street(50, 2.0, &objects, &errors);
        let mut model = Model::new(&scene, &DRIFTING, &SETTINGS);
        let found = searched(&scene, Vec::new());
        let lookout = Lookout::new(&scene, SETTINGS.viability.max_range_m);
        learn(&mut model, &lookout, &scene.usable_rays(), &found);
        let row = model.classes[0].to_row();
        let again = ClassModel::from_row(&row).map(|class| class.to_row());
        let bits = |row: &[f64]| row.iter().map(|number| number.to_bits()).collect::<Vec<u64>>();
        prop_assert_eq!(again.map(|again| bits(&again)), Some(bits(&row)));
        prop_assert!(ClassModel::from_row(&row[1..]).is_none());
        let mut other = Model::new(&scene, &DRIFTING, &SETTINGS);
        let own = other.classes[0];
        other.know(&[None], model.pooled, &Confusions::default());
        prop_assert_eq!(other.classes[0].ln_clutter_per_sr.to_bits(), own.ln_clutter_per_sr.to_bits());
        if model.pooled.is_learned {
            prop_assert_eq!(other.classes[0].rates, model.pooled.rates);
            prop_assert!(other.classes[0].heights.is_none());
        }
    }

    /// Pins that moves keep account of J: what is committed is what J says anew.
    #[test]
    fn the_energy_of_what_is_found_is_the_energy_of_its_votes(
        objects in vec(object(), 1..5), errors in errors_px()
    ) {
        let scene = street(50, 2.0, &objects, &errors);
        let found = searched(&scene, Vec::new());
        prop_assert!(!found.is_empty());
        let mut model = Model::new(&scene, &DRIFTING, &SETTINGS);
        let lookout = Lookout::new(&scene, SETTINGS.viability.max_range_m);
        learn(&mut model, &lookout, &scene.usable_rays(), &found);
        for one in found {
            let again = object_of(&model, &lookout, one.votes, one.fit.point).unwrap();
            prop_assert!((again.energy - one.energy).abs() < 1e-6 * one.energy.abs(), "{} {}", again.energy, one.energy);
        }
    }

    /// Pins that moves are committed only if J falls: from the truth, from a part of it, and from nothing.
    #[test]
    fn a_search_ends_with_no_more_energy_than_it_begins_with(
        objects in vec(object(), 1..3), errors in errors_px(), apart_m in 0.3..1.0_f64
    ) {
        let twins: Vec<Vector3<f64>> = objects.iter().flat_map(|at| [*at, at + Vector3::y() * apart_m]).collect();
        let scene = street(40, 3.0, &twins, &errors);
        let all = truth(&scene, &twins);
        let part: Vec<Placed> = all.iter().step_by(2).cloned().collect();
        for begun in [all, part, Vec::new()] {
            let before = as_it_is(&scene, begun.clone());
            let after = as_it_is(&scene, placed(&searched(&scene, begun)));
            prop_assert!(energy(&after) <= energy(&before) + 1e-6, "{} {}", energy(&after), energy(&before));
        }
    }

    /// Pins the move that makes one of two: it alone makes halves one.
    #[test]
    fn halves_of_one_object_become_one(object in object(), errors in errors_px()) {
        let scene = street(70, 2.0, &[object], &errors);
        let rays = scene.rays.rays.len() as u32;
        prop_assume!(rays >= 12);
        let (even, odd): (Vec<u32>, Vec<u32>) = (0..rays).partition(|ray| ray.is_multiple_of(2));
        let world = World::new(&scene, &[(even, object), (odd, object)]);
        prop_assert_eq!(votes(&world.rearranged()), BTreeSet::from([(0..rays).collect::<Vec<u32>>()]));
        prop_assert_eq!(searched(&scene, placed(&world.objects)).len(), 1);
    }

    /// Pins the exchange: it alone puts right what is swapped from one side.
    #[test]
    fn votes_that_are_swapped_from_one_side_are_put_right(errors in errors_px(), x in 0.3..1.2_f64, y in 0.3..1.2_f64) {
        let first = Vector3::new(40.0, 3.0, 3.0);
        let objects = [first, first + Vector3::new(x, y, 0.0)];
        let scene = crossing(objects, &errors);
        let right = truth(&scene, &objects);
        let along = |votes: &[u32], pass: u32| -> Vec<u32> {
            votes.iter().copied().filter(|&ray| scene.view(ray).pass == pass).collect()
        };
        let swapped = [(0, 1), (1, 0)].map(|(a, b)| {
            let votes = [along(&right[a].0, 0), along(&right[b].0, 1)].concat();
            (votes, 0.5 * (right[0].1 + right[1].1))
        });
        let world = World::new(&scene, &swapped);
        prop_assert_eq!(world.objects.len(), 2);
        let expected: BTreeSet<Vec<u32>> = right.into_iter().map(|(votes, _)| votes).collect();
        prop_assert_eq!(votes(&world.rearranged()), expected.clone());
        prop_assert_eq!(votes(&searched(&scene, swapped.to_vec())), expected);
    }

    /// Pins destroy and repair: no other move makes two of one.
    #[test]
    fn an_object_in_between_two_becomes_two(object in object(), errors in errors_px(), apart_m in 0.4..0.8_f64) {
        let objects = [object, object + Vector3::z() * apart_m];
        let scene = street(70, 2.0, &objects, &errors);
        let right = truth(&scene, &objects);
        prop_assume!(right.len() == 2 && right[0].0.len() >= 10);
        let between = right[0].0.iter().step_by(2).chain(right[1].0.iter().skip(1).step_by(2)).copied();
        let between: BTreeSet<u32> = between.collect();
        let world = World::new(&scene, &[(between.into_iter().collect(), 0.5 * (objects[0] + objects[1]))]);
        prop_assert_eq!(world.objects.len(), 1);
        let index = world.index();
        let objects = world.objects.clone();
        let found = repair(&world.model, &world.lookout, &index, objects, 0, &Progress::default()).unwrap().0;
        let expected: BTreeSet<Vec<u32>> = right.into_iter().map(|(votes, _)| votes).collect();
        prop_assert_eq!(found.len(), 2);
        prop_assert_eq!(votes(&searched(&scene, placed(&world.objects))), expected);
    }

    /// Pins that objects of many visits are tried in the parts that each side sees: rays of two back to back meet in between them, and drift explains it.
    #[test]
    fn what_many_drives_see_as_one_of_two_back_to_back_becomes_two(errors in errors_px(), apart_m in 1.5..1.9_f64) {
        let objects = [0.0, apart_m].map(|y| Vector3::new(45.0, 4.0 + y, 3.0));
        let back = Isometry3::new(Vector3::new(90.0, 8.0, 0.0), Vector3::z() * PI);
        let shown = back.inverse() * Point3::from(objects[1]);
        let drive = |i: usize| street(16, 2.0, &objects[..1], &errors[i..]);
        let drive_back = |i: usize| moved(street(16, 2.0, &[shown.coords], &errors[i..]), &back);
        let scene = joined((0..5).flat_map(|i| [drive(i), drive_back(i)]).collect());
        let noise = Noise { position_drift_m: 0.3, ..NOISE };
        let middle = 0.5 * (objects[0] + objects[1]);
        let all = vec![(scene.usable_rays(), middle)];
        prop_assert_eq!(as_found(&scene, &noise, all.clone(), false).len(), 1);
        prop_assert_eq!(as_found(&scene, &noise, all, true).len(), 2);
    }

    /// Pins that nothing stays whose J is positive, and the looks and the clutter in J: three of many images have a ray that meets by chance, the
    /// others have none.
    #[test]
    fn a_chance_meeting_of_clutter_dies(at in object(), errors in errors_px()) {
        let whole = street(60, 2.0, &[at], &errors);
        let count = whole.rays.rays.len() as u32;
        prop_assume!(count >= 15);
        let chance = [0, count / 2, count - 1];
        // In pictures so small that such meetings are common.
        let mut scene = cluttered(&whole, &chance, 3, &errors);
        scene.frusta[0].solid_angle_sr = 0.1;
        let votes: Vec<u32> = (0..scene.rays.rays.len() as u32)
            .filter(|&ray| scene.ray(ray).squared_error(&at) < 4.0)
            .collect();
        prop_assume!(votes.len() == 3);
        prop_assert!(World::new(&scene, &[(votes.clone(), at)]).objects[0].energy > 0.0);
        for depth in [Depth::Deep, Depth::Once, Depth::Shallow] {
            let mut model = Model::new(&scene, &DRIFTING, &SETTINGS);
            let rays: Vec<u32> = (0..scene.rays.rays.len() as u32).collect();
            let begun = vec![(votes.clone(), at)];
            let (found, _) =
                search(&mut model, &rays, begun, depth, true, &Progress::default()).unwrap();
            prop_assert!(found.iter().all(|one| (one.fit.point - at).norm() > 1.0), "{depth:?}: {:?}", found.iter().map(|o| (o.energy, o.votes.len(), o.real)).collect::<Vec<_>>());
        }
    }

    /// Pins what a bar of progress hears: every kind of move once a round, while it goes on.
    #[test]
    fn a_search_counts_its_moves(at in object(), errors in errors_px()) {
        let scene = street(40, 3.0, &[at], &errors);
        for (depth, moves) in [(Depth::Shallow, 1), (Depth::Once, 2), (Depth::Deep, 4)] {
            let (mut model, progress) = (Model::new(&scene, &DRIFTING, &SETTINGS), Progress::default());
            search(&mut model, &scene.usable_rays(), Vec::new(), depth, true, &progress).unwrap();
            prop_assert!(progress.done() >= moves && progress.done().is_multiple_of(moves), "{}", progress.done());
        }
    }

    /// Pins births where not all moves pay: what the initial map missed is no object of few looks, which each of its rays would grow anew.
    #[test]
    fn what_is_left_over_is_born_where_not_all_moves_pay(at in object(), errors in errors_px()) {
        let scene = street(40, 3.0, &[at], &errors);
        let all = scene.usable_rays();
        prop_assume!(all.len() >= 10);
        let mut model = Model::new(&scene, &DRIFTING, &SETTINGS);
        let found = search(&mut model, &all, Vec::new(), Depth::Once, false, &Progress::default()).map(|found| found.0);
        let found = found.unwrap();
        prop_assert_eq!(found.len(), 1);
        prop_assert!(2 * found[0].votes.len() > all.len());
    }

    /// Pins exclusion: two boxes of one thing are votes of two objects otherwise.
    #[test]
    fn boxes_that_are_doubled_double_no_object(objects in vec(object(), 1..4), errors in errors_px()) {
        let sizes = vec![0.8; objects.len()];
        let scene = with_sizes(street(40, 3.0, &objects, &errors), &objects, &sizes);
        let single = searched(&scene, Vec::new());
        let doubled = searched(&doubled(&scene, 1.5), Vec::new());
        prop_assert_eq!(doubled.len(), single.len());
    }

    /// Pins sizes in J: with boxes all alike the two become one.
    #[test]
    fn sizes_that_disagree_keep_objects_along_one_ray_apart(errors in errors_px()) {
        let objects = [Vector3::new(30.0, 1.0, 1.0), Vector3::new(45.0, 1.5, 1.5)];
        let mut scene = street(12, 1.0, &objects[..1], &errors);
        let far = street(12, 1.0, &objects[1..], &errors[11..]);
        // Images show the near one and the far one in turn.
        for image in (0..12).step_by(2) {
            Arc::make_mut(&mut scene.rays).rays[image] = far.rays.rays[image];
        }
        let begun: Vec<Placed> = [1, 0]
            .into_iter()
            .zip(objects)
            .map(|(odd, point)| ((0..12).filter(|ray| ray % 2 == odd).collect(), point))
            .collect();
        for (sizes_m, expected) in [([0.3, 1.5], 2), ([0.0, 0.0], 1)] {
            for (i, (votes, point)) in begun.iter().enumerate() {
                for &ray in votes {
                    let depth_m = scene.ray(ray).project(point).z;
                    scene.box_px[ray as usize] =
                        if sizes_m[i] > 0.0 { FOCAL_PX * sizes_m[i] / depth_m } else { 20.0 };
                }
            }
            prop_assert_eq!(searched(&scene, begun.clone()).len(), expected);
        }
    }

    /// Pins the misses in J: images that should have seen an object cost, those that look elsewhere do not.
    #[test]
    fn images_that_see_nothing_where_an_object_should_be_speak_against_it(object in object(), errors in errors_px()) {
        let whole = street(70, 2.0, &[object], &errors);
        let count = whole.rays.rays.len();
        prop_assume!(count >= 12);
        let kept: Vec<u32> = (0..count as u32).filter(|ray| ray % 3 == 0 || *ray + 1 == count as u32).collect();
        let mut scene = only(&whole, &kept);
        let away = Frustum { normals: vec![-Vector3::z()], ..scene.frusta[0].clone() };
        scene.frusta.push(away);
        let seen: BTreeSet<u32> = scene.rays.image.iter().copied().collect();
        let votes: Vec<u32> = (0..kept.len() as u32).collect();
        let looked = World::new(&scene, &[(votes.clone(), object)]).objects[0].clone();
        let mut turned = scene.clone();
        for (image, view) in (0..).zip(&mut turned.views) {
            view.camera = u32::from(!seen.contains(&image));
        }
        let looked_away = World::new(&turned, &[(votes, object)]).objects[0].clone();
        let expected = |object: &Object| object.seen.sectors.iter().flatten().map(|looks| looks.expected).sum::<f64>();
        prop_assert!(expected(&looked) > expected(&looked_away));
        prop_assert!((looked.fit.energy - looked_away.fit.energy).abs() < 1e-9 * looked.fit.energy.abs().max(1.0));
        prop_assert!(looked.energy > looked_away.energy + 1.0, "{} {}", looked.energy, looked_away.energy);
    }
}

#[test]
fn a_viewpoint_is_as_much_of_a_hit_as_the_share_of_its_images_that_see() {
    let object = Vector3::new(40.0, 5.0, 3.0);
    let mut scene = street(80, 0.25, &[object], &[[0.0, 0.0]]);
    for (image, view) in (0..).zip(&mut scene.views) {
        view.viewpoint = image / 4;
    }
    let model = Model::new(&scene, &NOISE, &SETTINGS);
    let hits = |every: usize| {
        let votes: Vec<u32> = scene.usable_rays().into_iter().step_by(every).collect();
        let seen = Lookout::new(&scene, 60.0).looks(&model, &object, &votes);
        let sum = |of: fn(&Looks) -> f64| seen.sectors.iter().flatten().map(of).sum::<f64>();
        (sum(|looks| looks.hits), sum(|looks| looks.expected))
    };
    let ((all, looks), (some, _)) = (hits(1), hits(4));
    assert!(looks > 10.0 && (all - looks).abs() < 1e-9, "{all} {looks}");
    assert!((some / all - 0.25).abs() < 0.05, "{some} {all}");
}

#[test]
fn what_nobody_sees_from_where_detections_vote_is_no_object() {
    // From 46 to 37 m away.
    let object = Vector3::new(46.0, 5.0, 3.0);
    let scene = street(10, 1.0, &[object], &[[0.2, 0.1], [-0.1, -0.2]]);
    let with = |max_range_m: f64| {
        let viability = Viability { max_range_m: max_range_m / VOTE_RANGE, ..SETTINGS.viability };
        let settings = Settings { viability, ..SETTINGS };
        fit(&Model::new(&scene, &NOISE, &settings), &scene.usable_rays(), object).is_some()
    };
    assert!(with(60.0) && with(40.0) && !with(30.0));
}

/// A scene with some of its rays alone.
fn only(scene: &Scene, kept: &[u32]) -> Scene {
    let mut part = scene.clone();
    let rays = Arc::make_mut(&mut part.rays);
    let of = |all: &[f64]| kept.iter().map(|&ray| all[ray as usize]).collect::<Vec<f64>>();
    rays.rays = kept.iter().map(|&ray| *scene.ray(ray)).collect();
    rays.image = kept.iter().map(|&ray| scene.rays.image[ray as usize]).collect();
    rays.class = kept.iter().map(|&ray| scene.rays.class[ray as usize]).collect();
    part.scale2 = of(&scene.scale2);
    part.box_px = of(&scene.box_px);
    part.score = of(&scene.score);
    part.range_m = of(&scene.range_m);
    part.range_sigma_m = of(&scene.range_sigma_m);
    part
}

/// Each ray of a scene `times` times, in the order of the images, each time with an axis that is moved by as much, px.
fn repeated(scene: &Scene, times: usize, moved_px: &dyn Fn(u32, usize) -> [f64; 2]) -> Scene {
    let rays: Vec<u32> = (0..scene.rays.rays.len() as u32).flat_map(|ray| vec![ray; times]).collect();
    let mut all = only(scene, &rays);
    for (i, ray) in Arc::make_mut(&mut all.rays).rays.iter_mut().enumerate() {
        let cam_from_world = scene.view(rays[i]).cam_from_world;
        let [u, v] = moved_px(rays[i], i % times);
        let in_camera = cam_from_world * ray.direction;
        let [u, v] = [in_camera.x / in_camera.z + u / FOCAL_PX, in_camera.y / in_camera.z + v / FOCAL_PX];
        let pixels = nalgebra::Matrix3::new(FOCAL_PX, 0.0, -FOCAL_PX * u, 0.0, FOCAL_PX, -FOCAL_PX * v, 0.0, 0.0, 1.0);
        ray.residual_from_world = pixels * cam_from_world;
        ray.direction = (cam_from_world.transpose() * Vector3::new(u, v, 1.0)).normalize();
    }
    all
}

/// Each ray twice, so many pixels apart.
fn doubled(scene: &Scene, apart_px: f64) -> Scene {
    repeated(scene, 2, &|_, copy| [copy as f64 * apart_px, 0.0])
}

/// Some rays of a scene as they are, and instead of all others clutter around them, the same number in all images.
fn cluttered(scene: &Scene, kept: &[u32], times: usize, errors: &[[f64; 2]]) -> Scene {
    let moved_px = |ray: u32, copy: usize| {
        if copy == 0 && kept.contains(&ray) {
            return [0.0, 0.0];
        }
        let mut error = errors[(ray as usize * 31 + copy * 17) % errors.len()];
        // Not where it would be a vote.
        error[0] = (250.0 * error[0].abs() + 25.0) * error[0].signum();
        error[1] *= 200.0;
        error
    };
    repeated(scene, times, &moved_px)
}

proptest! {
    #![proptest_config(few(8))]

    /// Pins the search as a whole, births (from nothing) and assignment: four images that show two objects, all sets of votes written out.
    #[test]
    fn the_search_finds_what_is_best_of_all_associations(
        x in 25.0..40.0_f64, y in 2.0..6.0_f64, z in 1.0..5.0_f64, apart_m in 0.1..0.6_f64, errors in errors_px()
    ) {
        let first = Vector3::new(x, y, z);
        let objects = [first, first + Vector3::y() * apart_m];
        let scene = street(4, 4.0, &objects, &errors);
        prop_assert_eq!(scene.rays.rays.len(), 8);
        let truth = truth(&scene, &objects);
        for begun in [truth, Vec::new()] {
            let found = searched(&scene, begun);
            let world = World::new(&scene, &placed(&found));
            // Of each image no ray, or one of both.
            let mut sets: Vec<(Vec<u32>, f64)> = Vec::new();
            for code in 0..81_u32 {
                let choice = (0..4).map(|image| (image, code / 3_u32.pow(image) % 3));
                let set: Vec<u32> = choice.filter(|(_, which)| *which > 0).map(|(image, which)| 2 * image + which - 1).collect();
                if set.len() >= 3 {
                    let of_starts = objects.iter().filter_map(|start| object_of(&world.model, &world.lookout, set.clone(), *start));
                    let least = of_starts.map(|one| one.energy).fold(0.0, f64::min);
                    sets.push((set, least));
                }
            }
            let mut least = 0.0_f64;
            for (i, (set, of_one)) in sets.iter().enumerate() {
                least = least.min(*of_one);
                for (other, of_other) in &sets[..i] {
                    if other.iter().all(|ray| !set.contains(ray)) {
                        least = least.min(of_one + of_other);
                    }
                }
            }
            let of_found: f64 = found.iter().map(|one| object_of(&world.model, &world.lookout, one.votes.clone(), one.fit.point).unwrap().energy).sum();
            // A fit ends within a fraction of its sigmas.
            prop_assert!((of_found - least).abs() < 0.05, "{of_found} {least}");
        }
    }
}
