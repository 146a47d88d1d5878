//! Heavy tails: detections that show an object and miss it by far more than the noise, equation (3a) of `docs/method.md`.
//!
//! A box that is half hidden, or merged with another, lies beside its object: it is no vote, and no clutter of the kind that is anywhere. Where many objects
//! stand, such boxes meet each other. So around an object that should have a vote in an image and has none, clutter is denser: by as much as detections of
//! no object are there more often than elsewhere, by how many sigmas they miss it.

use std::f64::consts::PI;

use nalgebra::Vector3;
use rayon::prelude::*;

use super::reach::LookedAt;
use crate::robust::energy::Object;
use crate::robust::energy::looks::Lookout;
use crate::robust::model::steps::{BINS, Steps, bin};
use crate::robust::model::{CHANCE_SIGMAS, ClassModel, Model};
use crate::robust::parts::Part;
use crate::robust::scene::Scene;

/// What misses an object by more gates than this does not show it. Of boxes that are five times as wrong as usual one in 170 is farther off, with a gate of
/// four sigmas (Rayleigh).
const WIDEST_GATES: f64 = 4.0;

/// Rays by image.
pub struct OfImages<'a> {
    scene: &'a Scene,
    rays: Vec<u32>,
}

impl<'a> OfImages<'a> {
    /// Some rays of a scene.
    #[must_use]
    pub fn new(scene: &'a Scene, rays: impl Iterator<Item = u32>) -> Self {
        let mut rays: Vec<u32> = rays.collect();
        rays.sort_unstable_by_key(|&ray| (scene.image_of(ray), ray));
        Self { scene, rays }
    }

    fn of(&self, image: u32) -> &[u32] {
        let begins = |image: u32| self.rays.partition_point(|&ray| self.scene.image_of(ray) < image);
        &self.rays[begins(image)..begins(image + 1)]
    }
}

/// What misses an object by more sigmas than this does not show it.
fn widest_sigmas(model: &Model<'_>) -> f64 {
    WIDEST_GATES * model.settings.gate_sigmas
}

/// How many detections of a class miss an object that has no vote in an image, per squared sigma of what a detection is off by, by sigmas; of the images
/// that look at sure objects, and the rays of no object. `ln_clutter_per_sr` is how dense those of each class are.
#[must_use]
pub fn tails(model: &Model<'_>, sure: &[LookedAt<'_>], free: &OfImages<'_>, ln_clutter_per_sr: &[f64]) -> Steps {
    let widest = widest_sigmas(model);
    let ring = |bin: usize| {
        let [inner, outer] = [bin, bin + 1].map(|edge| widest * edge as f64 / BINS as f64);
        PI * (outer * outer - inner * inner)
    };
    let (mut found, mut expected, mut looks) = ([0.0_f64; BINS], [0.0; BINS], 0.0);
    for LookedAt { object, images, .. } in sure {
        for &(image, _) in images.iter().filter(|(_, is_hit)| !is_hit) {
            let look = Look::new(model, object, image);
            looks += 1.0;
            for (bin, expected) in expected.iter_mut().enumerate() {
                *expected += ln_clutter_per_sr[object.class as usize].exp() * ring(bin) * look.variance_rad2;
            }
            for &ray in free.of(image) {
                let sigmas = look.sigmas(model, object, ray);
                if sigmas < widest {
                    found[bin(sigmas / widest)] += 1.0;
                }
            }
        }
    }
    // Within the gate a detection is a vote.
    let is_beyond = |bin: usize| WIDEST_GATES * bin as f64 >= BINS as f64;
    let density = |bin: usize| {
        let excess = found[bin] - expected[bin] - CHANCE_SIGMAS * found[bin].sqrt();
        if is_beyond(bin) && excess > 0.0 { excess / (looks * ring(bin)) } else { 0.0 }
    };
    let densities: [f64; BINS] = std::array::from_fn(density);
    if densities.iter().all(|density| *density == 0.0) { Steps::NONE } else { Steps::even(widest, densities) }
}

/// How much denser clutter is at each ray, in logarithms, as objects are missed there; empty where no class has tails.
#[must_use]
pub fn of_rays(model: &Model<'_>, lookout: &Lookout, rays: &[u32], objects: &[Object]) -> Vec<f64> {
    let has_tails = |class: &ClassModel| class.tails != Steps::NONE;
    if !model.settings.has(Part::Tails) || !model.classes.iter().any(has_tails) {
        return Vec::new();
    }
    let of_images = OfImages::new(model.scene, rays.iter().copied());
    let widest = widest_sigmas(model);
    let beside = |object: &Object| -> Vec<(u32, f64)> {
        let class = &model.classes[object.class as usize];
        if !has_tails(class) {
            return Vec::new();
        }
        let missed = lookout.seen(model, &object.fit.point, &object.votes, class.farthest_m);
        let missed = missed.into_iter().filter(|(_, is_hit)| !is_hit);
        let of_look = |(image, _): (u32, bool)| {
            let look = Look::new(model, object, image);
            let near = move |&ray: &u32| {
                let sigmas = look.sigmas(model, object, ray);
                (sigmas < widest).then(|| (ray, class.tails.at(sigmas) / look.variance_rad2))
            };
            of_images.of(image).iter().filter_map(near)
        };
        missed.flat_map(of_look).collect()
    };
    let mut per_sr = vec![0.0; model.scene.rays.rays.len()];
    // Added up in the order of objects, so that sums are the same with any threads; images of one object are in no order, and have other rays.
    for (ray, density) in objects.par_iter().map(beside).collect::<Vec<_>>().into_iter().flatten() {
        per_sr[ray as usize] += density;
    }
    let factor = |(ray, per_sr): (usize, f64)| (per_sr * (-model.class_of(ray as u32).ln_clutter_per_sr).exp()).ln_1p();
    per_sr.into_iter().enumerate().map(factor).collect()
}

/// An image that should show an object.
struct Look {
    direction: Vector3<f64>,
    /// What a detection of the object would be off by there, each axis.
    variance_rad2: f64,
}

impl Look {
    fn new(model: &Model<'_>, object: &Object, image: u32) -> Self {
        let away = object.fit.point - model.scene.views[image as usize].center;
        let (distance_m, like) = (away.norm(), object.votes[0] as usize);
        let variance_rad2 = model.spreads[like].variance(distance_m) / model.scene.scale2[like];
        Self { direction: away / distance_m, variance_rad2 }
    }

    /// By how many sigmas a ray of the object's class misses it; infinite for other classes.
    fn sigmas(&self, model: &Model<'_>, object: &Object, ray: u32) -> f64 {
        if model.scene.class_of(ray) != object.class {
            return f64::INFINITY;
        }
        let cosine = model.scene.ray(ray).direction.dot(&self.direction);
        ((2.0 - 2.0 * cosine).max(0.0) / self.variance_rad2).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::super::reach::looked_at;
    use super::*;
    use crate::robust::energy::object;
    use crate::street;

    const OBJECTS: usize = 6;

    fn objects_m() -> Vec<Vector3<f64>> {
        (0..OBJECTS).map(|i| Vector3::new(60.0 + 9.0 * i as f64, 5.0, 3.0)).collect()
    }

    /// Six objects in a street; every fifth detection misses its object by so many pixels.
    fn missing_by(px: f64) -> Scene {
        street::street(80, 1.0, &objects_m(), &[[0.1, 0.2], [0.3, -0.2], [px, 0.0], [-0.2, 0.1], [0.0, -0.3]])
    }

    /// The objects of a scene with the votes that do not miss them, and the other rays.
    fn found(model: &Model<'_>, lookout: &Lookout) -> (Vec<Object>, Vec<u32>) {
        let rays = model.scene.usable_rays();
        let of = |at: &Vector3<f64>| {
            let near = |ray: &u32| {
                let ray = model.scene.ray(*ray);
                (ray.direction - (at - ray.center).normalize()).norm() * street::FOCAL_PX < 2.0
            };
            object(model, lookout, rays.iter().copied().filter(near).collect(), *at)
        };
        let objects: Vec<Object> = objects_m().iter().filter_map(of).collect();
        let is_free = |ray: &u32| !objects.iter().any(|object| object.votes.contains(ray));
        let free = rays.iter().copied().filter(is_free).collect();
        (objects, free)
    }

    fn learned(scene: &Scene) -> Steps {
        let model = Model::new(scene, &street::NOISE, &street::SETTINGS);
        let lookout = Lookout::new(scene, street::VIABILITY.max_range_m);
        let (objects, free) = found(&model, &lookout);
        let looked_at = looked_at(&model, &lookout, &objects.iter().collect::<Vec<_>>(), 50.0);
        tails(&model, &looked_at, &OfImages::new(scene, free.into_iter()), &[-3.0])
    }

    #[test]
    fn what_misses_objects_more_often_than_clutter_is_anywhere_is_learned_by_how_far_it_misses() {
        let tails = learned(&missing_by(7.0));
        // A detection is off by 1.1 px, and 2 px where the camera is near.
        assert!(tails.at(6.0) > 1e-3 && tails.at(13.0) == 0.0 && tails.at(2.0) == 0.0, "{tails:?}");
        assert_eq!(learned(&missing_by(0.2)), Steps::NONE);
    }

    #[test]
    fn clutter_is_denser_beside_objects_that_are_missed_and_nowhere_else() {
        let scene = missing_by(7.0);
        let mut model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let (objects, free) = found(&model, &lookout);
        let rays = scene.usable_rays();
        assert!(of_rays(&model, &lookout, &rays, &objects).is_empty());
        model.classes[0].farthest_m = 50.0;
        model.classes[0].tails = learned(&scene);
        let told = of_rays(&model, &lookout, &rays, &objects);
        let denser = |rays: &[u32]| rays.iter().filter(|&&ray| told[ray as usize] > 1.0).count();
        assert!(denser(&free) * 10 > free.len() * 8, "{} of {}", denser(&free), free.len());
        // Of an object that is not missed in an image nothing is said there; others are far from it.
        let own = &objects[0].votes;
        assert!(denser(own) * 10 < own.len(), "{} of {}", denser(own), own.len());
        let price = |model: &Model<'_>, ray: u32| model.ln_clutter_per_px2(ray);
        let before = price(&model, free[0]);
        model.ln_tails = told;
        assert!(price(&model, free[0]) >= before && free.iter().any(|&ray| price(&model, ray) > before + 1.0));
    }

    #[test]
    fn a_class_is_missed_beside_the_clutter_of_its_own() {
        let scene = missing_by(7.0);
        let model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let (objects, free) = found(&model, &lookout);
        let looked_at = looked_at(&model, &lookout, &objects.iter().collect::<Vec<_>>(), 50.0);
        let free = OfImages::new(&scene, free.into_iter());
        let of = |densities: &[f64]| tails(&model, &looked_at, &free, densities);
        assert!(of(&[-3.0, 20.0]) == of(&[-3.0]) && of(&[20.0, -3.0]) == Steps::NONE);
    }
}
