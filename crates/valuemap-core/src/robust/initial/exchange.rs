//! Exchange: two neighbours may have each other's votes from some directions, and have moved so that these votes fit; then no
//! single vote changes sides.
//!
//! In an image that shows both, the difference of their detections does not depend on the pose error. It says where the one lies
//! from the other, up to which is which. Pairs of images propose differences of the positions; the one that explains most images
//! says in which images the two must be swapped.

use nalgebra::{Matrix2x3, Matrix3, Vector2, Vector3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::label::{Label, SECTOR_COSINE, direction_to, from_voters, sector_middles};
use super::pairs::{nearest_pairs, replaced};
use crate::robust::noise::Noise;
use crate::robust::scene::Scene;

/// Labels farther apart than this do not have each other's votes, m.
const PAIR_M: f64 = 2.5;
/// So many images must show both.
const MIN_IMAGES: usize = 6;
/// Images whose pairs propose how the labels lie to each other, at most.
const PROPOSERS: usize = 16;
/// Images that proposals are tried on, about.
const SAMPLE_IMAGES: usize = 64;
/// Times that the best proposal is fitted to all images that agree with it.
const REFINEMENTS: usize = 3;
/// No image speaks stronger against a proposal.
const CUT_CHI2: f64 = 16.0;
/// An exchange must lower the sum of squared residuals by so much.
const LEAST_GAIN: f64 = 8.0;

/// Let neighbours exchange votes where their images say so; what only one of them has in an image is given anew. The
/// nearest pairs first, each label in one pair.
#[must_use]
pub fn exchange(scene: &Scene, noise: &Noise, gate_sigmas: f64, labels: Vec<Label>) -> Vec<Label> {
    let is_open = |a: &Label, b: &Label| a.class == b.class && !a.known.untangled.contains(&b.identity());
    let pairs = nearest_pairs(&labels, PAIR_M, is_open);
    let of_pair = |&(a, b): &(usize, usize)| exchange_pair(scene, noise, gate_sigmas, &labels[a], &labels[b]);
    let exchanged = pairs.par_iter().map(of_pair).collect();
    replaced(labels, &pairs, exchanged, |known, neighbor| known.untangled.push(neighbor))
}

/// Both labels' detections in an image that shows both, and what their difference says.
struct Both {
    rays: [u32; 2],
    /// Unit direction from the labels to the camera.
    direction: Vector3<f64>,
    /// Difference of the residuals at a common point, px: that of the positions, seen from the image, if each ray is its
    /// label's.
    difference: Vector2<f64>,
    /// By the difference of the positions, px/m.
    by_point: Matrix2x3<f64>,
    /// Variance of the difference, each axis, px².
    variance: f64,
}

impl Both {
    /// Squared residual in sigmas if the labels are this far apart, as the rays are and swapped.
    fn chi2(&self, apart: &Vector3<f64>) -> [f64; 2] {
        let expected = self.by_point * apart;
        [1.0, -1.0].map(|sign| (self.difference * sign - expected).norm_squared() / self.variance)
    }
}

/// The two labels after an exchange; nothing if they are best as they are.
fn exchange_pair(scene: &Scene, noise: &Noise, gate_sigmas: f64, a: &Label, b: &Label) -> Option<Vec<Label>> {
    let images = images_of_both(scene, noise, a, b)?;
    if images.len() < MIN_IMAGES {
        return None;
    }
    let now = a.estimate.point - b.estimate.point;
    let unswapped: f64 = images.iter().map(|both| both.chi2(&now)[0].min(CUT_CHI2)).sum();
    let mut starts = flipped(&images);
    starts.push(proposed(&images, &now));
    let refined =
        starts.iter().filter_map(|start| (0..REFINEMENTS).try_fold(*start, |apart, _| refined(&images, &apart)));
    let (least, apart) = refined.map(|apart| (cost(&images, 1, &apart), apart)).min_by(|a, b| a.0.total_cmp(&b.0))?;
    if !(least < unswapped - LEAST_GAIN) {
        return None;
    }
    let swapped: Vec<bool> = images.iter().map(|both| both.chi2(&apart)).map(|[as_is, swap]| swap < as_is).collect();
    // Which is which is free to choose: so that fewer votes change sides.
    let mirrored = 2 * swapped.iter().filter(|&&swap| swap).count() > swapped.len();
    if swapped.iter().all(|&swap| swap == mirrored) {
        return None;
    }
    let of = |side: usize, old: &Label| {
        let ray = |(both, &swap): (&Both, &bool)| both.rays[side ^ usize::from(swap != mirrored)];
        let voters = images.iter().zip(&swapped).map(ray).collect();
        let found = from_voters(scene, noise, gate_sigmas, voters, old.estimate.point)?;
        Some(Label { unseen_from: old.unseen_from.clone(), ..found })
    };
    Some(vec![of(0, a)?, of(1, b)?])
}

/// The images in which both labels have a detection, by pass.
fn images_of_both(scene: &Scene, noise: &Noise, a: &Label, b: &Label) -> Option<Vec<Both>> {
    let middle = (a.estimate.point + b.estimate.point) * 0.5;
    let image = |ray: u32| scene.rays.image[ray as usize];
    let of_b: FxHashMap<u32, u32> = b.voters.iter().map(|&ray| (image(ray), ray)).collect();
    let shown = a.voters.iter().filter_map(|&ray| of_b.get(&image(ray)).map(|&other| [ray, other]));
    shown
        .map(|rays| {
            let (residual_a, rows) = scene.ray(rays[0]).linearize(&middle)?;
            let (residual_b, _) = scene.ray(rays[1]).linearize(&middle)?;
            Some(Both {
                rays,
                direction: direction_to(scene, rays[0], &middle),
                difference: Vector2::from(residual_b) - Vector2::from(residual_a),
                by_point: Matrix2x3::from_rows(&rows),
                variance: noise.detection_px2(scene, rays[0]) + noise.detection_px2(scene, rays[1]),
            })
        })
        .collect()
}

/// The differences of the positions if the votes of all images that look from about one direction are swapped.
fn flipped(images: &[Both]) -> Vec<Vector3<f64>> {
    let sectors = sector_middles(images.iter().map(|both| both.direction));
    let flip = |middle: &Vector3<f64>| {
        let sign = |both: &Both| if middle.dot(&both.direction) < SECTOR_COSINE { 1.0 } else { -1.0 };
        solve(images.iter().map(|both| (both, sign(both))))
    };
    sectors.iter().filter_map(flip).collect()
}

/// The difference of the positions that fits a sample of the images best, of those that pairs of images would have.
fn proposed(images: &[Both], now: &Vector3<f64>) -> Vector3<f64> {
    let stride = images.len().div_ceil(SAMPLE_IMAGES);
    let all = std::iter::once(*now).chain(proposals(images)).map(|apart| (cost(images, stride, &apart), apart));
    all.min_by(|a, b| a.0.total_cmp(&b.0)).map_or(*now, |(_, apart)| apart)
}

/// Differences of the positions that pairs of images would have.
fn proposals(images: &[Both]) -> Vec<Vector3<f64>> {
    let sample: Vec<&Both> = images.iter().step_by(images.len().div_ceil(PROPOSERS)).collect();
    let mut proposals = Vec::new();
    for (i, first) in sample.iter().enumerate() {
        for second in &sample[i + 1..] {
            proposals
                .extend([1.0, -1.0].iter().filter_map(|&sign| solve([(*first, 1.0), (*second, sign)].into_iter())));
        }
    }
    proposals
}

/// The difference of the positions that fits best if the images are swapped as it says.
fn refined(images: &[Both], apart: &Vector3<f64>) -> Option<Vector3<f64>> {
    let fitting = images.iter().filter_map(|both| {
        let [as_is, swap] = both.chi2(apart);
        (as_is.min(swap) < CUT_CHI2).then_some((both, if swap < as_is { -1.0 } else { 1.0 }))
    });
    solve(fitting)
}

/// Least squares, with a weak prior for what the images do not tell.
fn solve<'a>(images: impl Iterator<Item = (&'a Both, f64)>) -> Option<Vector3<f64>> {
    let mut information = Matrix3::identity() / (PAIR_M * PAIR_M);
    let mut sum = Vector3::zeros();
    for (both, sign) in images {
        information += both.by_point.transpose() * both.by_point / both.variance;
        sum += both.by_point.transpose() * both.difference * (sign / both.variance);
    }
    Some(information.cholesky()?.solve(&sum))
}

fn cost(images: &[Both], stride: usize, apart: &Vector3<f64>) -> f64 {
    let of_image = |both: &Both| {
        let [as_is, swap] = both.chi2(apart);
        as_is.min(swap).min(CUT_CHI2)
    };
    images.iter().step_by(stride).map(of_image).sum()
}
