//! Splits and merges: a label whose two sides disagree becomes two, and two labels that agree become one.
//!
//! Agreement is tested by the Mahalanobis distance of positions, since no distance in metres fits all covariances.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::label::{Label, direction_to, first_voter, from_voters, variance_factor};
use super::pairs::{disjoint, near_pairs, replaced};
use crate::robust::model::Model;
use crate::robust::scene::Scene;
use crate::robust::search::untangle::reach_m;

/// Squared Mahalanobis distance up to which two positions agree: the 99.7 % quantile of chi² with 3 degrees of freedom.
const AGREEMENT_CHI2: f64 = 14.0;
/// Squared Mahalanobis distance from which on they disagree: far beyond chance. One in 700,000 that agree is as far off.
const DISAGREEMENT_CHI2: f64 = 30.0;
/// Two sides are at least 60 degrees apart (cosine). Sides that reach 30 degrees around each (`ONE_SIDE_COSINE`) do not overlap then.
const SIDES_COSINE: f64 = 0.5;
/// Two labels may share this part of the images of the smaller one and still be one object: clutter beside it. Larger: two that images show side by side become
/// one; smaller: clutter beside an object keeps two labels of it.
const SHARED_IMAGES: f64 = 0.15;

/// Make one of any two labels of a class whose positions agree within their covariances, unless their images say that
/// they are two: images in which both have a detection of their own. The nearest pair first.
#[must_use]
pub fn fuse(model: &Model<'_>, labels: Vec<Label>) -> Vec<Label> {
    let mut labels = labels;
    let factor = variance_factor(model.scene, model.noise, &labels);
    loop {
        let agreeing = agreeing_pairs(model, &labels, AGREEMENT_CHI2 * factor);
        if agreeing.is_empty() {
            return labels;
        }
        let pairs = disjoint(agreeing);
        let fused = pairs.iter().map(|&(a, b)| Some(vec![union(model, &labels[a], &labels[b])]));
        let fused = fused.collect();
        labels = replaced(labels, &pairs, fused, |_, _| ());
    }
}

/// Make two of any label whose voters on two sides of it put it to places that do not agree: two lights back to back, say,
/// which no image shows together.
#[must_use]
pub fn split(model: &Model<'_>, labels: Vec<Label>) -> Vec<Label> {
    let min_votes = model.settings.min_votes;
    let factor = variance_factor(model.scene, model.noise, &labels);
    let parts = |mut label: Label| -> Vec<Label> {
        if label.known.is_one {
            return vec![label];
        }
        label.known.is_one = true;
        let sides = two_sides(model.scene, &label);
        if sides.iter().any(|side| side.len() < min_votes) {
            return vec![label];
        }
        let start = label.estimate.point;
        let apart = sides.map(|side| from_voters(model.scene, model.noise, model.settings.gate_sigmas, side, start));
        match apart {
            [Some(a), Some(b)]
                if a.voters.len().min(b.voters.len()) >= min_votes
                    && distance2(&a, &b).is_some_and(|distance2| distance2 > DISAGREEMENT_CHI2 * factor) =>
            {
                vec![a, b]
            }
            _ => vec![label],
        }
    };
    let mut labels: Vec<Label> = labels.into_par_iter().flat_map_iter(parts).collect();
    labels.sort_by_cached_key(first_voter);
    labels
}

/// Voters by the nearer of two opposite directions: two means of the directions to their cameras.
fn two_sides(scene: &Scene, label: &Label) -> [Vec<u32>; 2] {
    let directions: Vec<Vector3<f64>> =
        label.voters.iter().map(|&ray| direction_to(scene, ray, &label.estimate.point)).collect();
    let farthest = |from: &Vector3<f64>| {
        directions.iter().copied().min_by(|a, b| a.dot(from).total_cmp(&b.dot(from))).unwrap_or(*from)
    };
    let first = farthest(&label.side);
    let mut means = [first, farthest(&first)];
    for _ in 0..4 {
        let nearer = |d: &Vector3<f64>| usize::from(d.dot(&means[1]) > d.dot(&means[0]));
        let mut sums = [Vector3::zeros(); 2];
        for direction in &directions {
            sums[nearer(direction)] += direction;
        }
        means = [0, 1].map(|i| if sums[i].norm() > 0.0 { sums[i].normalize() } else { means[i] });
    }
    let mut sides = [Vec::new(), Vec::new()];
    if means[0].dot(&means[1]) < SIDES_COSINE {
        for (&ray, direction) in label.voters.iter().zip(&directions) {
            sides[usize::from(direction.dot(&means[1]) > direction.dot(&means[0]))].push(ray);
        }
    }
    sides
}

/// Squared Mahalanobis distance and numbers of labels of one class that agree and are not told apart.
fn agreeing_pairs(model: &Model<'_>, labels: &[Label], most: f64) -> Vec<(f64, usize, usize)> {
    let agreeing = |(a, b): (usize, usize)| {
        let (first, second) = (&labels[a], &labels[b]);
        let distance2 = (first.class == second.class).then(|| distance2(first, second)).flatten()?;
        (distance2 < most && !told_apart(model.scene, first, second)).then_some((distance2, a, b))
    };
    near_pairs(labels, reach_m(model)).into_par_iter().filter_map(agreeing).collect()
}

/// Squared Mahalanobis distance of two labels.
fn distance2(a: &Label, b: &Label) -> Option<f64> {
    let apart: Vector3<f64> = a.estimate.point - b.estimate.point;
    let together = (a.estimate.covariance + b.estimate.covariance).cholesky()?;
    Some(apart.dot(&together.solve(&apart)))
}

/// Whether images show both labels as detections of their own, more often than clutter would.
fn told_apart(scene: &Scene, a: &Label, b: &Label) -> bool {
    a.images_shared(b, scene) as f64 > 1.0 + SHARED_IMAGES * a.voters.len().min(b.voters.len()) as f64
}

/// Of images that both have, the larger label's detection stays.
fn union(model: &Model<'_>, a: &Label, b: &Label) -> Label {
    let Model { scene, noise, settings, .. } = *model;
    let (large, small) = if b.voters.len() > a.voters.len() { (b, a) } else { (a, b) };
    let images = large.images(scene);
    let mut voters = large.voters.clone();
    let new = |ray: &&u32| images.binary_search(&scene.image_of(**ray)).is_err();
    voters.extend(small.voters.iter().filter(new));
    from_voters(scene, noise, settings.gate_sigmas, voters, large.estimate.point).unwrap_or_else(|| large.clone())
}
