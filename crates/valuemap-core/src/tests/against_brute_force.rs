//! The fast paths of the core against the same thing done the slow way, on random scenes.

use crate::kernel::{Gate, Gates, LANES, instruction_sets};
use crate::paper::ballot::Ballot;
use crate::paper::hypothesis::propose;
use crate::paper::merge::merge;
use crate::paper::triangulate::refine;
use crate::paper::vote::Candidate;
use crate::progress::Progress;
use crate::ray::{Ray, Rays};
use crate::viability::Viability;
use nalgebra::{Matrix3, Rotation3, Vector3};
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

const FOCAL_PX: f64 = 500.0;

/// A pinhole's ray from `center` to `target`, seen at some pixel off the axis.
fn ray_to(target: Vector3<f64>, center: Vector3<f64>, off_axis: [f64; 2]) -> Ray {
    let turn = Rotation3::look_at_rh(&(target - center), &Vector3::new(0.1, 0.2, 1.0));
    // `look_at_rh` looks along -z; cameras look along +z. Then the axis is turned off the target.
    let flip = Rotation3::from_euler_angles(std::f64::consts::PI, 0.0, 0.0);
    let tilt = Rotation3::from_euler_angles(off_axis[0], off_axis[1], 0.0);
    let cam_from_world = (tilt * flip * turn).into_inner();
    let in_cam = cam_from_world * (target - center);
    let (u, v) = (in_cam.x / in_cam.z, in_cam.y / in_cam.z);
    let pixels = Matrix3::new(FOCAL_PX, 0.0, -FOCAL_PX * u, 0.0, FOCAL_PX, -FOCAL_PX * v, 0.0, 0.0, 1.0);
    Ray { residual_from_world: pixels * cam_from_world, center, direction: (target - center).normalize() }
}

/// The point nearest to two rays' lines: the middle of their common perpendicular.
///
/// Nothing for parallel rays. The depths may be negative.
fn midpoint(a: &Ray, b: &Ray) -> Option<Vector3<f64>> {
    let baseline = b.center - a.center;
    let cosine = a.direction.dot(&b.direction);
    let sine2 = 1.0 - cosine * cosine;
    if !(sine2 > 0.0) {
        return None;
    }
    let (along_a, along_b) = (a.direction.dot(&baseline), b.direction.dot(&baseline));
    let depth_a = (along_a - cosine * along_b) / sine2;
    let depth_b = (cosine * along_a - along_b) / sine2;
    Some(0.5 * (a.center + a.direction * depth_a + b.center + b.direction * depth_b))
}

fn point() -> impl Strategy<Value = Vector3<f64>> {
    (-40.0..40.0, -40.0..40.0, -10.0..10.0).prop_map(|(x, y, z)| Vector3::new(x, y, z))
}

fn ray() -> impl Strategy<Value = Ray> {
    (point(), point(), -0.5..0.5, -0.5..0.5)
        .prop_filter("a direction is needed", |(target, center, ..)| (target - center).norm() > 1.0)
        .prop_map(|(target, center, tilt, turn)| ray_to(target, center, [tilt, turn]))
}

/// Rays of ascending images, some images with many.
fn rays_of_images(count: std::ops::Range<usize>) -> impl Strategy<Value = (Vec<Ray>, Vec<u32>)> {
    let step = |same| prop_oneof![same => Just(0_u32), 1 => Just(1)];
    let rows = prop_oneof![vec((ray(), step(2)), count.clone()), vec((ray(), step(200)), count)];
    rows.prop_map(|rows| {
        let mut image = 0;
        rows.into_iter()
            .map(|(ray, step)| {
                image += step;
                (ray, image)
            })
            .unzip()
    })
}

/// The same cases in every run.
fn config() -> ProptestConfig {
    ProptestConfig { cases: 64, failure_persistence: None, rng_seed: RngSeed::Fixed(1), ..ProptestConfig::default() }
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn rays_pass_through_their_targets(target in point(), center in point(), tilt in -0.5..0.5, turn in -0.5..0.5) {
        prop_assume!((target - center).norm() > 1.0);
        let ray = ray_to(target, center, [tilt, turn]);
        prop_assert!(ray.squared_error(&target) < 1e-12);
        prop_assert!(ray.project(&target).z > 0.0);
        prop_assert!(ray.squared_error(&(2.0 * center - target)).is_infinite());
    }

    #[test]
    fn the_kernel_is_right_wherever_it_is_sure(
        rays in vec(ray(), 1..150), points in vec(point(), 1..40), radius_px in prop_oneof![Just(0.5), Just(6.0), Just(400.0)],
        floor_m2 in prop_oneof![Just(0.0), Just(0.04), Just(25.0)]
    ) {
        let lanes: Vec<u32> = (0..rays.len() as u32).map(|i| i + i / 10).collect();
        let gate = Gate { radius_px, floor_m2 };
        let gates = Gates::new(rays.iter().zip(&lanes).map(|(ray, &lane)| (lane, ray, gate)));
        for (name, arch) in instruction_sets() {
            let mut maybe = vec![u64::MAX; points.len() * gates.words()];
            let mut sure = maybe.clone();
            gates.test_on(arch, &points, &mut maybe, &mut sure);
            for (p, point) in points.iter().enumerate() {
                let bit = |rows: &[u64], lane: usize| rows[p * gates.words() + lane / LANES] >> (lane % LANES) & 1 == 1;
                for (ray, &lane) in rays.iter().zip(&lanes) {
                    let inside = gate.holds(&ray.project(point));
                    prop_assert!(!inside || bit(&maybe, lane as usize), "{name}");
                    prop_assert!(inside || !bit(&sure, lane as usize), "{name}");
                }
                let idle = (0..gates.words() * LANES).filter(|&lane| !lanes.contains(&(lane as u32)));
                prop_assert_eq!(idle.filter(|&lane| bit(&maybe, lane)).count(), 0, "{}", name);
            }
        }
        let [mut maybe, mut sure, mut alone] = [0, 0, u64::MAX].map(|word| vec![word; points.len() * gates.words()]);
        gates.test(&points, &mut maybe, &mut sure);
        gates.test_maybe(&points, &mut alone);
        prop_assert_eq!(alone, maybe);
    }

    #[test]
    fn the_ballot_counts_images_and_forgets_voters(
        (rays, image) in rays_of_images(1..300), points in vec(point(), 1..20), taken in vec(any::<prop::sample::Index>(), 0..60)
    ) {
        let gate = 150.0;
        let mut ballot = Ballot::cast(&points, &rays, &image, gate, &Progress::default()).unwrap();
        let mut in_gate: Vec<Vec<usize>> = points
            .iter()
            .map(|point| (0..rays.len()).filter(|&r| rays[r].squared_error(point) < gate * gate).collect())
            .collect();
        let images_of = |rays: &[usize]| {
            let mut images: Vec<u32> = rays.iter().map(|&r| image[r]).collect();
            images.dedup();
            images.len()
        };
        for (h, expected) in in_gate.iter().enumerate() {
            prop_assert_eq!(&ballot.rays(h).collect::<Vec<_>>(), expected);
            prop_assert_eq!(ballot.votes(h) as usize, images_of(expected));
        }
        let taken: Vec<usize> = taken.iter().map(|index| index.index(rays.len())).collect();
        let bits = ballot.bits_of(&taken);
        for (h, expected) in in_gate.iter_mut().enumerate() {
            let before = expected.len();
            expected.retain(|ray| !taken.contains(ray));
            prop_assert_eq!(ballot.remove(h, &bits), expected.len() < before);
            prop_assert_eq!(&ballot.rays(h).collect::<Vec<_>>(), &*expected);
            prop_assert_eq!(ballot.votes(h) as usize, images_of(expected));
        }
    }

    #[test]
    fn no_viable_pair_is_skipped((rays, image) in rays_of_images(2..60), error in prop_oneof![Just(2.0), Just(30.0)]) {
        let viability = Viability {
            max_reprojection_error_px: error, min_parallax_rad: 0.2, min_range_m: 1.0, max_range_m: 60.0,
        };
        let (found, counts) = propose(&rays, &image, &viability, &Progress::default()).unwrap();
        let mut expected = Vec::new();
        for a in 0..rays.len() {
            for b in (a + 1..rays.len()).filter(|&b| image[b] != image[a]) {
                let cosine = rays[a].direction.dot(&rays[b].direction);
                if cosine >= viability.min_parallax_rad.cos() {
                    continue;
                }
                // The middle may lie behind a camera though the best point does not: several starts, the best counts.
                let along = [2.0, 10.0, 30.0, 60.0].map(|depth| rays[a].center + rays[a].direction * depth);
                let starts = midpoint(&rays[a], &rays[b]).into_iter().chain(along);
                let pair = [&rays[a], &rays[b]];
                let cost = |point: &Vector3<f64>| pair.iter().map(|ray| ray.squared_error(point)).sum::<f64>();
                let ends = starts.filter_map(|start| refine(&pair.into_iter(), start));
                let Some(point) = ends.min_by(|p, q| cost(p).total_cmp(&cost(q))) else { continue };
                let errors = [a, b].map(|r| rays[r].squared_error(&point));
                let ranges = [a, b].map(|r| (point - rays[r].center).norm());
                if errors.iter().all(|&e| e < error * error) && ranges.iter().all(|r| (1.0..=60.0).contains(r)) {
                    expected.push((a as u32, b as u32, point));
                }
            }
        }
        prop_assert_eq!(found.len(), expected.len());
        for (h, (a, b, point)) in found.iter().zip(expected) {
            prop_assert_eq!((h.a, h.b), (a, b));
            // Where the minimum is flat, points of equal cost may lie micrometres apart.
            let cost = |p: &Vector3<f64>| [a, b].map(|r| rays[r as usize].squared_error(p)).iter().sum::<f64>();
            prop_assert!((h.point - point).norm() < 1e-4);
            prop_assert!((cost(&h.point) - cost(&point)).abs() <= 1e-9 * (1.0 + cost(&point)));
        }
        prop_assert_eq!(
            counts.pairs,
            counts.parallax + counts.reprojection + counts.behind + counts.range + counts.hypotheses
        );
    }

    #[test]
    fn refinement_finds_the_minimum(
        target in point(), centers in vec(point(), 3..12), noise in vec((-3.0..3.0, -3.0..3.0), 12), start in point()
    ) {
        prop_assume!(centers.iter().all(|c| (target - c).norm() > 5.0));
        let rays: Vec<Ray> = centers
            .iter()
            .zip(&noise)
            .map(|(&center, &(dx, dy))| {
                let mut ray = ray_to(target, center, [0.1, -0.2]);
                let depth_row = ray.residual_from_world.row(2).into_owned();
                for (row, shift) in [dx, dy].into_iter().enumerate() {
                    let moved = ray.residual_from_world.row(row) - depth_row * shift;
                    ray.residual_from_world.set_row(row, &moved);
                }
                ray
            })
            .collect();
        let cost = |p: &Vector3<f64>| rays.iter().map(|ray| ray.squared_error(p)).sum::<f64>();
        let best = refine(&rays.iter(), target + start * 0.01).unwrap();
        prop_assert!(cost(&best) <= cost(&target));
        for step in [Vector3::x(), Vector3::y(), Vector3::z(), -Vector3::x(), -Vector3::y(), -Vector3::z()] {
            prop_assert!(cost(&best) <= cost(&(best + step * 1e-4)) + 1e-9);
        }
    }
}

fn candidates(offsets_m: &[f64], clusters: &[u32], classes: &[u32]) -> (Rays, Vec<Candidate>) {
    let mut rays = Rays::default();
    let mut found = Vec::new();
    for (i, (&offset, (&cluster, &class))) in offsets_m.iter().zip(clusters.iter().zip(classes)).enumerate() {
        let target = Vector3::new(30.0 + offset, 5.0, 4.0);
        let first = rays.rays.len() as u32;
        for k in 0..3_u32 {
            rays.rays.push(ray_to(target, Vector3::new(f64::from(k) * 8.0, 0.0, 0.0), [0.0, 0.0]));
            rays.image.push(i as u32 * 3 + k);
            rays.class.push(class);
        }
        found.push(Candidate { point: target, clusters: vec![cluster], voters: (first..first + 3).collect() });
    }
    (rays, found)
}

fn voters(labels: &[Candidate]) -> Vec<usize> {
    labels.iter().map(|label| label.voters.len()).collect()
}

#[test]
fn one_object_of_three_clusters_becomes_one_label() {
    let (rays, found) = candidates(&[0.0, 0.4, 0.8, 5.0], &[0, 1, 2, 3], &[0; 4]);
    let merged = merge(&rays, found, 1.0);
    assert_eq!(voters(&merged), [9, 3]);
    assert_eq!(merged[0].clusters, [0, 1, 2]);
    assert!((merged[0].point.x - 30.4).abs() < 0.1);
}

#[test]
fn objects_told_apart_in_one_cluster_stay_apart() {
    let (rays, found) = candidates(&[0.0, 0.6, 0.1], &[0, 0, 1], &[0; 3]);
    assert_eq!(voters(&merge(&rays, found, 1.0)), [6, 3]);
}

#[test]
fn classes_and_distant_objects_stay_apart() {
    let (rays, found) = candidates(&[0.0, 0.1, 1.2], &[0, 1, 2], &[0, 1, 0]);
    assert_eq!(voters(&merge(&rays, found, 1.0)), [3, 3, 3]);
}

#[test]
fn a_merged_label_may_come_within_reach_of_another() {
    // The last two merge first; the middle of them, 0.95 m away, then takes the first, which the second could not.
    let (rays, found) = candidates(&[0.0, 1.0, 0.9], &[0, 1, 2], &[0; 3]);
    assert_eq!(voters(&merge(&rays, found, 1.0)), [9]);
}

#[test]
fn nothing_merges_to_nothing() {
    assert!(merge(&Rays::default(), Vec::new(), 1.0).is_empty());
}

#[test]
fn lanes_without_a_ray_answer_nothing_however_far_points_are() {
    let ray = ray_to(Vector3::new(10.0, 0.0, 0.0), Vector3::zeros(), [0.0, 0.0]);
    let gates = Gates::new([(3, &ray, Gate { radius_px: 6.0, floor_m2: 0.04 })].into_iter());
    let far = [Vector3::new(3e7, -2e7, 1e7), Vector3::new(1e12, 1e12, 1e12)];
    for (name, arch) in instruction_sets() {
        let (mut maybe, mut sure) = (vec![0; 2], vec![0; 2]);
        gates.test_on(arch, &far, &mut maybe, &mut sure);
        assert!(maybe.iter().chain(&sure).all(|word| word & !(1 << 3) == 0), "{name}: {maybe:?}");
    }
}
