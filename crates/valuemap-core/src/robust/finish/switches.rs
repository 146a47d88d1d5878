//! Identity switches: an object that begins to be seen where another one ends, and never beside it, is that other one.
//!
//! Poses that are off by some metres put what is seen from there somewhere else, and two objects then have less J than one. In
//! the pictures it is one: its box hardly moves from one image to the next. Images a few metres apart have the same pose error,
//! so their residuals at a place nearby differ by errors of single images alone, however wrong the place and the poses are.

use super::one::{probability_of_one, share_of_one};
use crate::robust::energy::estimate::{Estimate, visits};
use crate::robust::energy::looks::looks_among;
use crate::robust::energy::{Object, implied_size};
use crate::robust::model::Model;
use crate::robust::noise::drift::SEGMENT_M;
use crate::robust::parts::Part;
use crate::robust::search::rearrange::may_be_one;

/// However many images miss two things, that is no more improbable: what hides one from an image, hides it from the next as well.
const HIDDEN: f64 = 1e-3;

/// Whether each of some objects, with where they are, is another one of them in the pictures, which J would miss more.
#[must_use]
pub fn are_others(model: &Model<'_>, objects: &[&Object], estimates: &[Estimate]) -> Vec<bool> {
    let mut switches =
        if model.settings.has(Part::IdentitySwitches) { switches(model, objects, estimates) } else { Vec::new() };
    let energy = |i: usize| objects[i].energy;
    switches
        .sort_by(|a, b| energy(a.0).total_cmp(&energy(b.0)).then(energy(a.1).total_cmp(&energy(b.1))).then(a.cmp(b)));
    let mut is_left_out = vec![false; objects.len()];
    for (stronger, weaker) in switches {
        is_left_out[weaker] |= !is_left_out[stronger];
    }
    is_left_out
}

/// Pairs of objects that are one in the pictures, the stronger one first.
fn switches(model: &Model<'_>, objects: &[&Object], estimates: &[Estimate]) -> Vec<(usize, usize)> {
    let mut votes: Vec<(u32, usize)> =
        objects.iter().enumerate().flat_map(|(i, object)| object.votes.iter().map(move |&ray| (ray, i))).collect();
    votes.sort_unstable();
    let in_order = |(i, k): (usize, usize)| if objects[i].energy <= objects[k].energy { (i, k) } else { (k, i) };
    let pairs = (0..votes.len()).filter_map(|at| goes_on_as(model, objects, &votes[at..]));
    let mut pairs: Vec<(usize, usize)> = pairs.map(in_order).collect();
    pairs.sort_unstable();
    pairs.dedup();
    let are_two = |&(stronger, weaker): &(usize, usize)| are_seen_as_two(model, objects[stronger], objects[weaker]);
    let (two, one): (Vec<_>, Vec<_>) = pairs.into_iter().partition(are_two);
    let odds = |&(stronger, weaker): &(usize, usize)| {
        so_far_apart(&estimates[stronger], &estimates[weaker])
            / missed_by_the_other(model, objects[stronger], objects[weaker])
    };
    let odds: Vec<f64> = one.iter().map(odds).collect();
    let share = share_of_one(&odds, two.len());
    one.into_iter().zip(odds).filter(|(_, odds)| probability_of_one(share, *odds) > 0.5).map(|(pair, _)| pair).collect()
}

/// The object of the first of some votes (ray and object, ascending), and another one that the camera sees in its place in the next images.
fn goes_on_as(model: &Model<'_>, objects: &[&Object], votes: &[(u32, usize)]) -> Option<(usize, usize)> {
    let (&(ray, here), after) = votes.split_first()?;
    let (scene, view) = (model.scene, model.scene.view(ray));
    let image = |vote: &(u32, usize)| scene.image_of(vote.0);
    for next in after.chunk_by(|a, b| image(a) == image(b)) {
        let there = scene.view(next[0].0);
        if there.pass != view.pass || there.driven_m - view.driven_m > SEGMENT_M {
            return None;
        }
        if there.camera != view.camera || image(&next[0]) == image(&votes[0]) {
            continue;
        }
        if next.iter().any(|vote| vote.1 == here) {
            return None;
        }
        let goes_on = |vote: &&(u32, usize)| show_one(model, [objects[here], objects[vote.1]], [ray, vote.0]);
        if let Some(&(_, other)) = next.iter().find(goes_on) {
            return Some((here, other));
        }
    }
    None
}

/// Whether an image shows both of two objects, or the weaker one is seen on more than one visit.
fn are_seen_as_two(model: &Model<'_>, stronger: &Object, weaker: &Object) -> bool {
    weaker.is_seen_beside(model.scene, stronger) || visits(model.scene, &weaker.votes).count() > 1
}

/// How probable it is that each of two objects is missed in all images of the other that look at it.
fn missed_by_the_other(model: &Model<'_>, stronger: &Object, weaker: &Object) -> f64 {
    let looks = looks_among(model, stronger, &weaker.votes) + looks_among(model, weaker, &stronger.votes);
    (1.0 - model.classes[stronger.class as usize].rates.recall).powf(looks).max(HIDDEN)
}

/// How probable it is at most that one thing is estimated in two places so far apart, whatever its errors are like (Chebyshev's inequality of three
/// dimensions).
fn so_far_apart(a: &Estimate, b: &Estimate) -> f64 {
    let apart_m = a.point - b.point;
    let inverse = (a.covariance + b.covariance).try_inverse();
    inverse.map_or(1.0, |inverse| (3.0 / apart_m.dot(&(inverse * apart_m))).min(1.0))
}

/// Whether two rays, one of each of two objects, show one thing in two images nearby: as near to each other, and as large, as one thing would be.
fn show_one(model: &Model<'_>, objects: [&Object; 2], rays: [u32; 2]) -> bool {
    let (scene, gate) = (model.scene, model.settings.gate_sigmas);
    let is_one = |object: &Object| {
        let point = object.fit.point;
        let [a, b] = rays.map(|ray| scene.ray(ray).project(&point));
        let [x, y] = [a, b].map(|projected| projected.xy() / projected.z);
        let own_px2 = |ray: u32, depth_m: f64| model.noise.own(scene, ray).variance(depth_m);
        let is_near = (x - y).norm_squared() <= gate * gate * (own_px2(rays[0], a.z) + own_px2(rays[1], b.z));
        let [s, t] = rays.map(|ray| implied_size(model, ray, &point));
        a.z > 0.0 && b.z > 0.0 && is_near && model.class_of(rays[0]).sizes.agree(s, t, gate)
    };
    may_be_one(model, objects[0], objects[1]) && objects.into_iter().any(is_one)
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};

    use super::*;
    use crate::robust::energy::looks::Lookout;
    use crate::robust::energy::object;
    use crate::robust::scene::Scene;
    use crate::street::{NOISE, SETTINGS, joined, street};

    const SIGN: [f64; 3] = [40.0, 2.0, 1.0];

    /// A sign, and another one three metres behind it.
    fn drive() -> Scene {
        let other = Vector3::from(SIGN) + Vector3::new(3.0, 1.0, 0.0);
        street(60, 1.0, &[SIGN.into(), other], &[[0.3, -0.2], [-0.4, 0.1], [0.2, 0.4]])
    }

    /// The votes of objects, by number of the sign, image and pass; the second one is where wrong poses put it. Whether each is another one.
    fn of_votes(scene: &Scene, votes: &[&dyn Fn(usize, u32, u32) -> bool]) -> Vec<bool> {
        of_votes_known_to(scene, votes, 1.0)
    }

    /// The same of objects that are known to so many metres.
    fn of_votes_known_to(scene: &Scene, votes: &[&dyn Fn(usize, u32, u32) -> bool], sigma_m: f64) -> Vec<bool> {
        let model = Model::new(scene, &NOISE, &SETTINGS);
        let lookout = Lookout::new(scene, SETTINGS.viability.max_range_m);
        let number = |ray: u32| ray as usize - scene.rays.image.partition_point(|&image| image < scene.image_of(ray));
        let first_of_pass = |pass: u32| scene.views.partition_point(|view| view.pass < pass) as u32;
        let begun = |is_vote: &dyn Fn(usize, u32, u32) -> bool| -> Option<Object> {
            let of = |ray: &u32| {
                let pass = scene.view(*ray).pass;
                is_vote(number(*ray), scene.image_of(*ray) - first_of_pass(pass), pass)
            };
            let votes: Vec<u32> = (0..scene.rays.rays.len() as u32).filter(of).collect();
            object(&model, &lookout, votes, SIGN.into())
        };
        let mut objects: Vec<Object> = votes.iter().filter_map(|of| begun(*of)).collect();
        objects[1].fit.point += Vector3::new(1.5, 1.0, 0.3);
        assert!(objects[0].energy < objects[1].energy);
        let covariance = Matrix3::identity() * sigma_m * sigma_m;
        let estimate = |object: &Object| Estimate { point: object.fit.point, covariance };
        let estimates: Vec<Estimate> = objects.iter().map(estimate).collect();
        are_others(&model, &objects.iter().collect::<Vec<_>>(), &estimates)
    }

    #[test]
    fn what_takes_an_object_s_place_in_the_pictures_is_that_object() {
        let far = |sign, image, _| sign == 0 && image < 25;
        let near = |sign, image, _| sign == 0 && image >= 25;
        assert_eq!(of_votes(&drive(), &[&far, &near]), [false, true]);
    }

    #[test]
    fn what_is_elsewhere_in_the_pictures_is_not() {
        let far = |sign, image, _| sign == 0 && image < 25;
        let of_other = |sign, image, _| sign == 1 && image >= 25;
        assert_eq!(of_votes(&drive(), &[&far, &of_other]), [false, false]);
    }

    #[test]
    fn what_is_much_larger_is_not() {
        let mut scene = drive();
        let rays = scene.rays.clone();
        scene.box_px.iter_mut().zip(&rays.image).filter(|(_, image)| **image >= 25).for_each(|(size, _)| *size *= 50.0);
        let far = |sign, image, _| sign == 0 && image < 25;
        let near = |sign, image, _| sign == 0 && image >= 25;
        assert_eq!(of_votes(&scene, &[&far, &near]), [false, false]);
    }

    #[test]
    fn what_is_seen_beside_it_is_not() {
        let far = |sign, image, _| sign == 0 && image < 25;
        let near = |sign, image, _| sign == 0 && image >= 25 || sign == 1 && image == 10;
        assert_eq!(of_votes(&drive(), &[&far, &near]), [false, false]);
    }

    #[test]
    fn what_is_seen_on_two_visits_is_not() {
        let scene = joined(vec![drive(), drive()]);
        let far = |sign, image, pass| sign == 0 && image < 25 && pass == 0;
        let near = |sign, image, _| sign == 0 && image >= 25;
        assert_eq!(of_votes(&scene, &[&far, &near]), [false, false]);
    }

    #[test]
    fn what_few_images_show_is_not() {
        let far = |sign, image, _| sign == 0 && (23..25).contains(&image);
        let near = |sign, image, _| sign == 0 && (25..27).contains(&image);
        assert_eq!(of_votes_known_to(&drive(), &[&far, &near], 0.12), [false, false]);
        let more = |sign, image, _| sign == 0 && (20..25).contains(&image);
        assert_eq!(of_votes_known_to(&drive(), &[&more, &near], 0.12), [false, true]);
    }

    #[test]
    fn more_images_are_needed_where_both_are_known_to_be_far_apart() {
        let far = |sign, image, _| sign == 0 && image < 25;
        let near = |sign, image, _| sign == 0 && image >= 25;
        let begun = |sign, image, _| sign == 0 && (25..27).contains(&image);
        let few = |sign, image, _| sign == 0 && (23..25).contains(&image);
        assert_eq!(of_votes_known_to(&drive(), &[&few, &begun], 1.0), [false, true]);
        assert_eq!(of_votes_known_to(&drive(), &[&few, &begun], 0.1), [false, false]);
        assert_eq!(of_votes_known_to(&drive(), &[&far, &near], 0.2), [false, true]);
    }

    #[test]
    fn however_many_images_miss_it_they_may_have_one_reason() {
        let far = |sign, image, _| sign == 0 && image < 25;
        let near = |sign, image, _| sign == 0 && image >= 25;
        assert_eq!(of_votes_known_to(&drive(), &[&far, &near], 0.02), [false, false]);
    }
}
