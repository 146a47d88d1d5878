//! What the car carries: a reflection in the windshield, an emblem, a caption in the picture.
//!
//! It stays at its place of the picture while the car drives, so that its rays are about parallel and meet anywhere far away. J knows no such thing, and clutter
//! does not come again at the same place: so each of its rays speaks for an object. Here what an object is otherwise has a second term beside clutter:
//! that all its votes show one thing which the car carries. The first of them is one more box of clutter then, and the others come where it is: so the price
//! depends on what is learned of the class alone, and not on how many images are mapped together.

use std::f64::consts::TAU;

use nalgebra::Vector3;

use crate::robust::energy::Object;
use crate::robust::model::Model;
use crate::robust::parts::Part;

/// The probability that an object is none which the car carries: of the one, of the other and of clutter, all of which explain its votes.
#[must_use]
pub fn not_carried(model: &Model<'_>, object: &Object) -> f64 {
    let carried = energy_if_carried(model, object);
    if carried == f64::INFINITY || !model.settings.has(Part::Carried) {
        return 1.0;
    }
    let there = -0.5 * object.energy;
    let ln_there_or_clutter = there.max(0.0) + (-there.abs()).exp().ln_1p();
    1.0 / (1.0 + (-0.5 * carried - ln_there_or_clutter).exp())
}

/// J of the votes of an object if they show one thing that the car carries, against clutter. Infinite where several passes or cameras see it, or one place
/// alone: nothing shows then that it stays.
fn energy_if_carried(model: &Model<'_>, object: &Object) -> f64 {
    let scene = model.scene;
    let first = scene.view(object.votes[0]);
    let of_first = |&ray: &u32| (scene.view(ray).pass, scene.view(ray).camera) == (first.pass, first.camera);
    let is_elsewhere = |&ray: &u32| scene.view(ray).viewpoint != first.viewpoint;
    if !object.votes.iter().all(of_first) || !object.votes.iter().any(is_elsewhere) {
        return f64::INFINITY;
    }
    // Errors of poses do not move it: only those of detections do.
    let variance = |ray: u32| model.noise.detection_px2(scene, ray) / scene.scale2[ray as usize];
    let direction = |ray: u32| scene.view(ray).cam_from_world * scene.ray(ray).direction;
    let votes = || object.votes.iter().copied();
    let information: f64 = votes().map(|ray| 1.0 / variance(ray)).sum();
    let middle = votes().map(|ray| direction(ray) / variance(ray)).sum::<Vector3<f64>>().normalize();
    let of_vote =
        |ray: u32| (direction(ray) - middle).norm_squared() / variance(ray) + 2.0 * (TAU * variance(ray)).ln();
    let ln_clutter_per_sr = |ray: u32| model.ln_clutter_per_px2(ray) + scene.scale2[ray as usize].ln();
    votes().map(of_vote).sum::<f64>()
        + 2.0 * votes().skip(1).map(ln_clutter_per_sr).sum::<f64>()
        + 2.0 * (information / TAU).ln()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::ray::Ray;
    use crate::robust::energy::anywhere;
    use crate::robust::energy::seen::Seen;
    use crate::robust::scene::Scene;
    use crate::street::{self, street};

    /// What ten images show: an object ahead, or what is in all of them where it is in the first, up to its errors.
    fn seen_by_ten(stays: bool) -> Scene {
        let errors: Vec<[f64; 2]> = (0..97).map(|i| [(f64::from(i) * 1.7).sin(), (f64::from(i) * 2.3).cos()]).collect();
        let ahead = Vector3::new(45.0, 4.0, 3.0);
        let mut scene = street(10, 1.0, &[ahead], &errors);
        if stays {
            for (i, ray) in Arc::make_mut(&mut scene.rays).rays.iter_mut().enumerate() {
                let in_first = street(1, 1.0, &[ahead], &errors[i..]).rays.rays[0];
                *ray = Ray { center: ray.center, ..in_first };
            }
        }
        scene
    }

    /// The probability that it is not carried, if J of it is -100.
    fn of(scene: &Scene) -> f64 {
        of_model(&Model::new(scene, &street::NOISE, &street::SETTINGS))
    }

    fn of_model(model: &Model<'_>) -> f64 {
        not_carried(model, &anywhere(10, Seen::default(), -100.0))
    }

    #[test]
    fn what_stays_at_its_place_of_the_picture_is_carried() {
        let [stays, moves] = [true, false].map(|stays| of(&seen_by_ten(stays)));
        assert!(stays < 0.1, "{stays}");
        assert!(moves > 0.999, "{moves}");
    }

    #[test]
    fn images_that_are_mapped_with_it_do_not_change_whether_it_is_carried() {
        // As a tile and the whole have it.
        let tile = seen_by_ten(true);
        let mut whole = tile.clone();
        whole.views.extend_from_within(..);
        let [of_tile, of_whole] = [&tile, &whole].map(|scene| {
            let mut model = Model::new(scene, &street::NOISE, &street::SETTINGS);
            // What is learned of classes is learned once for all tiles. So dense that both are probable.
            model.classes[0].ln_clutter_per_sr = 4.6;
            of_model(&model)
        });
        assert_eq!(of_tile.to_bits(), of_whole.to_bits());
        assert!((0.01..0.99).contains(&of_tile), "{of_tile}");
    }

    #[test]
    fn what_two_passes_see_or_one_place_is_not_carried() {
        let mut of_two = seen_by_ten(true);
        of_two.views.iter_mut().skip(5).for_each(|view| view.pass = 1);
        assert_eq!(of(&of_two).to_bits(), 1.0_f64.to_bits());
        let mut standing = seen_by_ten(true);
        standing.views.iter_mut().for_each(|view| view.viewpoint = 0);
        assert_eq!(of(&standing).to_bits(), 1.0_f64.to_bits());
    }
}
