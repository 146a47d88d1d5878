//! Fusion: two labels that agree become one.
//!
//! Agreement is tested by the Mahalanobis distance of positions, since no distance in metres fits all covariances.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::label::{Label, from_voters, variance_factor};
use super::pairs::{disjoint, near_pairs, replaced};
use crate::robust::model::Model;
use crate::robust::scene::Scene;
use crate::robust::search::untangle::reach_m;

/// Squared Mahalanobis distance up to which two positions agree: the 99.7 % quantile of chi² with 3 degrees of freedom.
const AGREEMENT_CHI2: f64 = 14.0;
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
    let new = |ray: &&u32| images.binary_search(&scene.rays.image[**ray as usize]).is_err();
    voters.extend(small.voters.iter().filter(new));
    from_voters(scene, noise, settings.gate_sigmas, voters, large.estimate.point).unwrap_or_else(|| large.clone())
}
