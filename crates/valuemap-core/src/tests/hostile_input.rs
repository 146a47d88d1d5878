//! Whole streets of which numbers are spoiled, through every function that the Python package calls.
//!
//! What is spoiled are numbers that the border lets pass: it refuses arrays of other lengths, indices beyond the end and
//! infinities, which `benchmarks/fuzz.py` tries from Python. No case may panic, and what comes out is finite and in its bounds.
//!
//! `VALUEMAP_FUZZ_CASES=N` sets the cases of each test, `VALUEMAP_FUZZ_SEED=N` which.

use std::env::var;
use std::fmt::Debug;
use std::str::FromStr;
use std::sync::{Arc, LazyLock};

use crate::evidence::{max_angle, median, sight};
use crate::paper::merge::merge;
use crate::paper::partition::partition;
use crate::paper::select::Stop;
use crate::paper::triangulate::unit_covariance;
use crate::paper::vote::{Candidate, count_units, vote};
use crate::progress::Progress;
use crate::ray::{Ray, Rays};
use crate::robust::calibrate::likeliest::misfits;
use crate::robust::calibrate::{Calibration, self_calibrate};
use crate::robust::find;
use crate::robust::model::ClassModel;
use crate::robust::model::confusions::Confusions;
use crate::robust::noise::Known;
use crate::robust::noise::Noise;
use crate::robust::parts::{Part, Without};
use crate::robust::scene::{Frustum, Scene, View};
use crate::robust::settings::Settings;
use crate::street;
use crate::viability::Viability;
use nalgebra::{Matrix3, Vector3};
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::sample::{Index, select};
use proptest::test_runner::{RngSeed, TestRunner};
use rayon::ThreadPoolBuilder;

/// Numbers that are seldom thought of.
const NUMBERS: [f64; 28] = [
    0.0, -0.0, 1.0, -1.0, 0.5, 1e-320, 1e-160, 1e-12, 1e-6, 1e-3, 7.0, 90.0, 360.0, 1e4, 1e5, 1e7, 1e9, 1e12, 1e18,
    1e38, 1e154, 1e200, 1e308, -1e308, -1e18, -1e9, -1e5, -1e3,
];
/// No place is farther from the origin of its world, m, and no deviation larger: the border refuses such.
const FARTHEST: f64 = 1e12;
/// No range is longer, m.
const LONGEST_M: f64 = 1e6;
/// Nothing that is learned is larger.
const LARGEST_LEARNED: f64 = 1e6;
/// No gate is wider, sigmas.
const WIDEST_GATE: f64 = 1e3;
/// No greatest range is shorter, m.
const SHORTEST_M: f64 = 1e-6;

fn hostile() -> impl Strategy<Value = f64> {
    prop_oneof![3 => select(&NUMBERS[..]), 1 => -1e3..1e3_f64, 1 => Just(f64::NAN)]
}

/// A number that is spoiled: whose it is, and what it becomes.
type Spoil = (Index, Index, f64);

/// What arrays hold before they are a scene.
#[derive(Debug, Clone)]
struct Columns {
    residual_from_cam: Vec<[f64; 9]>,
    direction_in_cam: Vec<[f64; 3]>,
    image: Vec<u32>,
    class: Vec<u32>,
    box_px: Vec<f64>,
    score: Vec<f64>,
    range_m: Vec<f64>,
    range_sigma_m: Vec<f64>,
    cam_from_world: Vec<[f64; 9]>,
    center: Vec<[f64; 3]>,
    camera: Vec<u32>,
    pass: Vec<u32>,
    viewpoint: Vec<u32>,
    driven_m: Vec<f64>,
    position_sigma_m: Vec<f64>,
    rotation_sigma_rad: Vec<f64>,
    normals: Vec<[f64; 3]>,
    solid_angle_sr: Vec<f64>,
}

impl Columns {
    /// A drive or two past a few objects, of two classes and cameras.
    fn whole(images: usize, spacing_m: f64, objects: &[Vector3<f64>], errors: &[[f64; 2]]) -> Self {
        let rotation = Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0);
        let scene = street::street(images, spacing_m, objects, errors);
        let rows_of = |m: &Matrix3<f64>| m.transpose().as_slice().try_into().unwrap();
        let count = scene.rays.rays.len();
        let in_cam = |ray: &Ray| rotation * ray.direction;
        Self {
            residual_from_cam: scene
                .rays
                .rays
                .iter()
                .map(|ray| rows_of(&(ray.residual_from_world * rotation.transpose())))
                .collect(),
            direction_in_cam: scene.rays.rays.iter().map(|ray| in_cam(ray).into()).collect(),
            image: scene.rays.image.clone(),
            class: scene.rays.rays.iter().map(|ray| u32::from(in_cam(ray).x > 0.0)).collect(),
            box_px: scene.box_px,
            score: scene.score,
            range_m: scene.range_m,
            range_sigma_m: vec![1.0; count],
            cam_from_world: vec![rows_of(&rotation); images],
            center: scene.views.iter().map(|view| view.center.into()).collect(),
            camera: (0..images as u32).map(|image| image % 2).collect(),
            pass: (0..images as u32).map(|image| u32::from(image as usize > images / 2)).collect(),
            viewpoint: (0..images as u32).collect(),
            driven_m: scene.views.iter().map(|view| view.driven_m).collect(),
            position_sigma_m: vec![f64::NAN; images],
            rotation_sigma_rad: vec![f64::NAN; images],
            normals: vec![[1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, -1.0, 1.0]],
            solid_angle_sr: vec![1.5, 12.0],
        }
    }

    /// Write a number over one of a column; where none or infinity is refused, over nothing.
    fn spoil(&mut self, (column, row, number): Spoil) {
        fn put(values: &mut [f64], row: Index, number: f64, may_be_none: bool) {
            if !values.is_empty() && (may_be_none || number.is_finite()) {
                *row.get_mut(values) = number;
            }
        }
        fn code(values: &mut [u32], row: Index, below: u32, number: f64) {
            if !values.is_empty() {
                *row.get_mut(values) = (number.abs() as u32) % below;
            }
        }
        let near = number.clamp(-FARTHEST, FARTHEST);
        let (images, cameras) = (self.center.len() as u32, self.solid_angle_sr.len() as u32);
        match column.index(20) {
            0 => put(self.residual_from_cam.as_flattened_mut(), row, near, true),
            1 => put(self.direction_in_cam.as_flattened_mut(), row, near, true),
            2 => code(&mut self.image, row, images, number),
            3 => code(&mut self.class, row, 1000, number),
            4 => put(&mut self.box_px, row, near, false),
            5 => put(&mut self.score, row, number, true),
            6 => put(&mut self.range_m, row, number, true),
            7 => put(&mut self.range_sigma_m, row, number, true),
            8 => put(self.cam_from_world.as_flattened_mut(), row, near, false),
            9 => put(self.center.as_flattened_mut(), row, near, false),
            10 => code(&mut self.camera, row, cameras, number),
            11 => code(&mut self.pass, row, u32::MAX, number),
            12 => code(&mut self.viewpoint, row, u32::MAX, number),
            13 => put(&mut self.driven_m, row, near, false),
            14 => put(&mut self.position_sigma_m, row, number, true),
            15 => put(&mut self.rotation_sigma_rad, row, number, true),
            16 => put(self.normals.as_flattened_mut(), row, near, false),
            17 => put(&mut self.solid_angle_sr, row, near, false),
            // All at once: the columns that many rows share a value in.
            18 if near.is_finite() => self.center.iter_mut().for_each(|center| center[row.index(3)] = near),
            19 if near.is_finite() => self.box_px.fill(near),
            _ => {}
        }
    }

    fn scene(&self) -> Scene {
        let matrix = crate::matrix_from_rows;
        let of_ray = |((m, &direction), &image): ((&[f64; 9], &[f64; 3]), &u32)| {
            let image = image as usize;
            Ray::of_camera(
                &matrix(m),
                direction.into(),
                &matrix(&self.cam_from_world[image]),
                self.center[image].into(),
            )
        };
        let rays: Vec<Ray> =
            self.residual_from_cam.iter().zip(&self.direction_in_cam).zip(&self.image).map(of_ray).collect();
        let view = |i: usize| View {
            center: self.center[i].into(),
            cam_from_world: matrix(&self.cam_from_world[i]),
            camera: self.camera[i],
            pass: self.pass[i],
            viewpoint: self.viewpoint[i],
            driven_m: self.driven_m[i],
            position_sigma_m: self.position_sigma_m[i],
            rotation_sigma_rad: self.rotation_sigma_rad[i],
        };
        let frustum = |(i, &solid_angle_sr): (usize, &f64)| Frustum {
            normals: if i == 0 { self.normals.iter().map(|&n| n.into()).collect() } else { Vec::new() },
            solid_angle_sr,
            blind: None,
        };
        let mut scene = Scene {
            scale2: rays.iter().map(Ray::pixels_per_unit2).collect(),
            rays: Arc::new(Rays { rays, image: self.image.clone(), class: self.class.clone() }),
            box_px: self.box_px.clone(),
            score: self.score.clone(),
            range_m: self.range_m.clone(),
            range_sigma_m: self.range_sigma_m.clone(),
            views: (0..self.center.len()).map(view).collect(),
            frusta: self.solid_angle_sr.iter().enumerate().map(frustum).collect(),
        };
        scene.find_blind_sides();
        scene
    }
}

/// Streets of few images, most of them with a number or some spoiled.
fn columns(most_images: usize) -> impl Strategy<Value = Columns> {
    let spoils = prop_oneof![1 => vec((any::<Index>(), any::<Index>(), hostile()), 0..=1),
        3 => vec((any::<Index>(), any::<Index>(), hostile()), 1..6)];
    let spacing = prop_oneof![4 => 1.0..8.0_f64, 1 => Just(0.0)];
    (0..=most_images, spacing, vec(street::object(), 0..4), vec([-1.0..1.0, -1.0..1.0], 7), spoils).prop_map(
        |(images, spacing, objects, errors, spoils)| {
            let mut columns = Columns::whole(images, spacing, &objects, &errors);
            for spoil in spoils {
                columns.spoil(spoil);
            }
            columns
        },
    )
}

/// The noise where it is usual, with a number of it spoiled now and then.
fn noise() -> impl Strategy<Value = Noise> {
    let usual = [1.0, 0.05, 0.05, 1e-3, 0.05, 1e-3, 0.05, 1e-3, 0.0, 0.5];
    (0..24_usize, hostile()).prop_map(move |(which, number)| {
        let mut n = usual;
        let number = number.abs().min(FARTHEST);
        if which < n.len() && number.is_finite() && (which > 0 || number > 0.0) {
            n[which] = number;
        }
        Noise {
            detection_px: n[0],
            box_share: n[1],
            position_m: n[2],
            rotation_rad: n[3],
            position_segment_m: n[4],
            rotation_segment_rad: n[5],
            position_drift_m: n[6],
            rotation_drift_rad: n[7],
            side_m: n[8],
            // At the border it is below 1.
            look_correlation: if n[9] < 1.0 { n[9] } else { 0.0 },
        }
    })
}

/// One part of the method, or none.
fn names(number: usize) -> Vec<String> {
    Part::ALL.get(number % (Part::ALL.len() + 1)).map(|(_, name)| (*name).to_owned()).into_iter().collect()
}

fn settings() -> impl Strategy<Value = Settings> {
    let votes = prop_oneof![4 => 0..4_u32, 1 => Just(u32::MAX)];
    (0..24_usize, hostile(), votes.clone(), votes, any::<usize>()).prop_map(
        |(which, number, min_votes, least_votes, part)| {
            let mut s = [0.035, 2.0, 60.0, 3.5, 0.5];
            if which < s.len() && number.is_finite() {
                s[which] = number;
            }
            let [min_parallax_rad, min_range_m, max_range_m, gate_sigmas, min_existence] = s;
            // The border refuses others.
            let min_range_m = min_range_m.abs().min(LONGEST_M / 10.0);
            let max_range_m = max_range_m.min(LONGEST_M);
            let max_range_m = if max_range_m >= SHORTEST_M && max_range_m > min_range_m {
                max_range_m
            } else {
                2.0 * min_range_m + 1.0
            };
            let gate_sigmas = if gate_sigmas > 0.0 { gate_sigmas.min(WIDEST_GATE) } else { 3.5 };
            let viability =
                Viability { max_reprojection_error_px: f64::NAN, min_parallax_rad, min_range_m, max_range_m };
            Settings {
                viability,
                gate_sigmas,
                min_votes: min_votes as usize,
                least_votes: least_votes as usize,
                min_existence,
                without: Without::named(&names(part)).unwrap_or_default(),
            }
        },
    )
}

/// What is learned of a class of a good street, as numbers.
static LEARNED: LazyLock<Vec<f64>> = LazyLock::new(|| {
    let objects: Vec<Vector3<f64>> =
        (0..12).map(|i| Vector3::new(20.0 + 9.0 * f64::from(i), 6.0 - f64::from(i % 3), 4.0)).collect();
    let scene = street::street(60, 2.0, &objects, &[[0.4, -0.2], [-0.5, 0.3], [0.1, 0.6]]);
    let known = Known { detection: true, position: true, rotation: true, least_px: 0.0 };
    let found = self_calibrate(&scene, &street::NOISE, known, &street::SETTINGS, false, None, &Progress::default());
    found.unwrap().0.pooled.to_row()
});

fn class_model() -> impl Strategy<Value = ClassModel> {
    let spoils = prop_oneof![2 => Just(Vec::new()), 1 => vec((any::<Index>(), hostile()), 1..4)];
    spoils.prop_map(|spoils| {
        let mut row = LEARNED.clone();
        for (at, number) in spoils {
            *at.get_mut(&mut row) = number.clamp(-LARGEST_LEARNED, LARGEST_LEARNED);
        }
        ClassModel::from_row(&row).unwrap()
    })
}

fn all_finite<'a>(what: &str, numbers: impl IntoIterator<Item = &'a f64>) -> Result<(), TestCaseError> {
    for number in numbers {
        prop_assert!(number.is_finite(), "{what}: {number}");
    }
    Ok(())
}

fn number_from<T: FromStr>(name: &str, usual: T) -> T
where
    T::Err: Debug,
{
    var(name).map_or(usual, |text| text.parse().unwrap())
}

/// Run so many cases of a kind, on one thread, and say what was run.
fn run<S: Strategy>(kind: &str, cases: u32, strategy: &S, test: impl Fn(S::Value) -> Result<(), TestCaseError>) {
    let cases = number_from("VALUEMAP_FUZZ_CASES", cases);
    let config = ProptestConfig {
        cases,
        failure_persistence: None,
        rng_seed: RngSeed::Fixed(number_from("VALUEMAP_FUZZ_SEED", 1)),
        max_shrink_iters: 20_000,
        ..ProptestConfig::default()
    };
    // No case is worth waking other threads for.
    let _pool = ThreadPoolBuilder::new().num_threads(1).use_current_thread().build().unwrap();
    TestRunner::new(config).run(strategy, test).unwrap_or_else(|fault| panic!("{kind}: {fault}"));
    println!("{kind}: {cases} cases");
}

#[test]
fn partitions_of_hostile_positions() {
    let center = prop_oneof![4 => [-1e3..1e3, -1e3..1e3, -10.0..10.0_f64].boxed(), 1 => [hostile(), hostile(), hostile()].boxed()]
        .prop_map(|c| c.map(|number| if number.is_finite() { number.clamp(-FARTHEST, FARTHEST) } else { 0.0 }));
    let radius = prop_oneof![0.0..100.0, hostile()].prop_filter("finite", |radius: &f64| radius.is_finite());
    run("partition", 500, &(vec(center, 0..30), radius), |(centers, radius)| {
        let cluster = partition(&centers, radius);
        prop_assert_eq!(cluster.len(), centers.len());
        prop_assert!(cluster.iter().all(|&cluster| (cluster as usize) < centers.len()));
        Ok(())
    });
}

#[test]
fn votes_of_hostile_rays() {
    let usual = [3.0, 0.035, 2.0, 60.0, 0.5];
    let numbers = (0..15_usize, hostile()).prop_map(move |(which, number)| {
        let mut numbers = usual;
        if which < numbers.len() && number.is_finite() {
            numbers[which] = number;
        }
        numbers
    });
    let votes = prop_oneof![4 => 0..4_u32, 1 => Just(u32::MAX)];
    let merge_radius = prop_oneof![Just(1.0), hostile()].prop_filter("finite", |radius: &f64| radius.is_finite());
    let cases = (columns(12), numbers, votes, merge_radius, any::<u32>());
    run("vote, merge", 300, &cases, |(columns, numbers, min_votes, merge_radius, clusters)| {
        let [max_reprojection_error_px, min_parallax_rad, min_range_m, max_range_m, min_vote_ratio] = numbers;
        let rays = Arc::clone(&columns.scene().rays);
        // As the images of a place are.
        let cluster = partition(&columns.center, 10.0 + f64::from(clusters % 1000));
        let cluster: Vec<u32> = columns.image.iter().map(|&image| cluster[image as usize]).collect();
        let viability = Viability { max_reprojection_error_px, min_parallax_rad, min_range_m, max_range_m };
        let stop = Stop { min_vote_ratio, min_votes };
        prop_assert!(count_units(&rays, &cluster) <= cluster.len());
        let (labels, _) = vote(&rays, &cluster, &viability, &stop, &Progress::default()).unwrap();
        let merged = merge(&rays, labels.clone(), merge_radius);
        prop_assert!(merged.len() <= labels.len());
        for label in labels.iter().chain(&merged) {
            all_finite("point", label.point.iter())?;
            prop_assert!(!label.voters.is_empty() && label.voters.is_sorted_by(|a, b| a < b));
        }
        Ok(())
    });
}

#[test]
fn evidence_of_hostile_points() {
    let point = prop_oneof![[20.0..140.0, -9.0..9.0, 1.0..6.0_f64].boxed(), [hostile(), hostile(), hostile()].boxed()]
        .prop_map(|c| c.map(|number| number.clamp(-FARTHEST, FARTHEST)));
    run("evidence", 300, &(columns(6), vec(point, 1..4), vec(hostile(), 0..9)), |(columns, points, mut values)| {
        let rays = &columns.scene().rays.rays;
        for point in points {
            let point: Vector3<f64> = point.into();
            let covariance = unit_covariance(rays.iter(), &point);
            prop_assert!(
                covariance.iter().all(|c| !c.is_nan())
                    || rays.iter().any(|ray| !ray.is_usable())
                    || point.iter().any(|p| !p.is_finite()),
                "{}",
                covariance
            );
            let angle = max_angle(rays.iter(), &point);
            prop_assert!(angle.is_nan() || (0.0..=3.15).contains(&angle), "{angle}");
            for ray in rays {
                let seen = sight(ray, &point);
                prop_assert!(!(seen.residual_px < 0.0));
            }
        }
        let labels: Vec<Candidate> = Vec::new();
        prop_assert!(merge(&columns.scene().rays, labels, 1.0).is_empty());
        let middle = median(&mut values);
        prop_assert!(values.is_empty() || values.iter().any(|value| value.is_nan()) || !middle.is_nan());
        Ok(())
    });
}

#[test]
fn labels_of_hostile_scenes() {
    let classes = vec(proptest::option::of(class_model()), 0..3);
    let shares = vec(vec((0..4_u32, 0.0..=1.0_f64), 0..3), 0..3);
    let cases = (columns(12), [noise(), noise()], any::<bool>(), classes, class_model(), shares, settings());
    run("find", 200, &cases, |(columns, [noise, noise_of_covariances], is_deep, classes, pooled, shares, settings)| {
        let scene = columns.scene();
        let confusions = Confusions::of_shares(shares.clone());
        let calibration = Calibration { noise, noise_of_covariances, classes, pooled, confusions, is_deep };
        let found = find(&scene, &calibration, &settings, &Progress::default()).unwrap();
        for finding in &found.findings {
            all_finite("point", finding.estimate.point.iter())?;
            all_finite("covariance", finding.estimate.covariance.iter())?;
            prop_assert!((0.0..=1.0).contains(&finding.existence), "existence {}", finding.existence);
            prop_assert!(!finding.votes.is_empty() && finding.votes.is_sorted_by(|a, b| a < b));
            prop_assert!(finding.expected as usize <= scene.views.len(), "expected {}", finding.expected);
        }
        all_finite("variance factor", [&found.variance_factor])?;
        Ok(())
    });
}

fn known() -> impl Strategy<Value = Known> {
    (any::<[bool; 3]>(), any::<f64>()).prop_map(|([detection, position, rotation], least_px)| Known {
        detection,
        position,
        rotation,
        least_px,
    })
}

#[test]
fn noise_of_hostile_scenes() {
    let cases = (columns(10), noise(), known(), settings(), any::<bool>());
    run("calibrate", 50, &cases, |(columns, guess, known, settings, is_part)| {
        let scene = columns.scene();
        let found = self_calibrate(&scene, &guess, known, &settings, is_part, None, &Progress::default()).unwrap().0;
        for n in [&found.noise, &found.noise_of_covariances] {
            all_finite("detection noise", [&n.detection_px, &n.box_share])?;
            all_finite("noise of positions", [&n.position_m, &n.position_segment_m, &n.position_drift_m, &n.side_m])?;
            all_finite("noise of rotations", [&n.rotation_rad, &n.rotation_segment_rad, &n.rotation_drift_rad])?;
            prop_assert!(n.detection_px > 0.0, "detection noise {}", n.detection_px);
        }
        let row = found.pooled.to_row();
        prop_assert_eq!(row.len(), LEARNED.len());
        Ok(())
    });
}

#[test]
fn misfits_of_hostile_scenes() {
    let cases = (columns(8), columns(8), noise(), known(), settings(), any::<bool>());
    run("misfits", 40, &cases, |(first, second, guess, known, settings, turns)| {
        let (first, second) = (first.scene(), second.scene());
        let count = first.rays.rays.len();
        // Of the same rays, in the same order or the other.
        let second = if second.rays.rays.len() == count { second } else { first.clone() };
        let numbers = 0..count as u32;
        let numbers: Vec<u32> = if turns { numbers.rev().collect() } else { numbers.collect() };
        let found = misfits([&first, &second], &numbers, &guess, known, &settings, &Progress::default()).unwrap();
        prop_assert!(found.rays <= count);
        Ok(())
    });
}

#[test]
fn objects_of_hostile_scenes() {
    let point = prop_oneof![4 => [20.0..140.0, -9.0..9.0, 1.0..6.0_f64].boxed(), 1 => [hostile(), hostile(), hostile()].boxed()]
        .prop_map(|c| c.map(|number| if number.is_finite() { number.clamp(-FARTHEST, FARTHEST) } else { 0.0 }));
    let begun = vec((point, vec(any::<Index>(), 1..6)), 0..4);
    run(
        "objects",
        200,
        &(columns(10), noise(), settings(), begun, any::<bool>()),
        |(columns, noise, settings, begun, is_searched)| {
            let scene = columns.scene();
            let count = scene.rays.rays.len();
            let begun = begun.into_iter().filter(|_| count > 0).map(|(point, votes)| {
                let mut votes: Vec<u32> = votes.iter().map(|ray| ray.index(count) as u32).collect();
                votes.sort_unstable();
                votes.dedup();
                (votes, point.into())
            });
            let progress = Progress::default();
            let found = street::objects_of(&scene, &noise, &settings, begun.collect(), is_searched, &progress).unwrap();
            for object in &found {
                all_finite("point", object.fit.point.iter())?;
                prop_assert!(!object.energy.is_nan());
                prop_assert!(!object.votes.is_empty());
            }
            Ok(())
        },
    );
}
