//! Sizes of boxes as observations of depth: the boxes of one object have one physical size.
//!
//! With the logarithms a of a box's angle, d of its depth and s of the object's size, `a + d - s` is an error of standard
//! deviation `spread`, and s has the mean and standard deviation of its class, `object`. The size is marginalised, which leaves
//! an observation of the position. Boxes of one visit share their errors and count as one. It goes with size in equation (4) of
//! `docs/method.md`.

use nalgebra::{Matrix3, Vector3};

use super::estimate::visits;
use super::usual_size;
use crate::robust::model::Model;
use crate::robust::model::prior::Prior;
use crate::robust::noise::huber::HUBER_SIGMAS;

/// What the boxes of votes of one object say about its position, linearised at a point; nothing where boxes tell nothing.
#[must_use]
pub fn size_terms(model: &Model<'_>, votes: &[u32], point: &Vector3<f64>) -> Option<Prior> {
    let sizes = model.class_of_votes(votes)?.sizes;
    // Before sizes are learned, they prune and no more.
    if !sizes.tell() || sizes.object.0.is_nan() {
        return None;
    }
    let place_of = |&ray: &u32| {
        let depth_m = model.scene.ray(ray).project(point).z;
        (depth_m, model.ln_angle[ray as usize] + depth_m.ln())
    };
    let implied: Vec<(f64, f64)> = votes.iter().map(place_of).collect();
    let usual = usual_size(model, votes, implied.iter().map(|(_, size)| *size));
    let per_square = 1.0 / (sizes.spread * sizes.spread);
    let (mean, of_prior) = (sizes.object.0, 1.0 / (sizes.object.1 * sizes.object.1));
    let mut boxes: Vec<(f64, f64, Vector3<f64>)> = Vec::with_capacity(votes.len());
    let looks = visits(model.scene, votes).flat_map(|visit| visit.iter().map(|&ray| (ray, visit.len() as f64)));
    for ((ray, together), (depth_m, size)) in looks.zip(implied) {
        let cast = model.scene.ray(ray);
        if size.is_finite() {
            let weight = (HUBER_SIGMAS * sizes.spread / (size - usual).abs()).min(1.0) * per_square / together;
            boxes.push((weight, size, cast.residual_from_world.row(2).transpose() / depth_m));
        }
    }
    let all = of_prior + boxes.iter().map(|(weight, ..)| weight).sum::<f64>();
    let size = (mean * of_prior + boxes.iter().map(|(weight, size, _)| weight * size).sum::<f64>()) / all;
    let away = size - mean;
    let mut terms = Prior { information: Matrix3::zeros(), gradient: Vector3::zeros(), square: away * away * of_prior };
    let mut pull = Vector3::zeros();
    for (weight, of_box, by_point) in boxes {
        let error = of_box - size;
        terms.square += weight * error * error;
        terms.gradient += by_point * (weight * error);
        terms.information += by_point * by_point.transpose() * weight;
        pull += by_point * weight;
    }
    terms.information -= pull * pull.transpose() / all;
    Some(terms)
}
