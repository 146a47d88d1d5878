//! What a map tells about each class: detection rates, sizes, heights, distances, birth density, clutter and scores.
//!
//! Robust moments over sure objects, and expectation maximisation for the rates. Classes of too few sure objects are taken to be like all together.

pub mod aspect;
pub mod company;
pub mod confusion;
pub mod counts;
pub mod existence;
pub mod rates;
pub mod reach;
pub mod tails;

use crate::robust::energy::looks::Lookout;
use crate::robust::energy::{LEAST_VOTES, Object, SURE_VOTES, are_taken, implied_size};
use crate::robust::model::heights::{Heights, ground_m2 as ground_m2_within, height_m};
use crate::robust::model::steps::{elevation_factor, score_ratio};
use crate::robust::model::{ClassModel, Model, median};
use crate::robust::parts::Part;
use aspect::aspect;
use company::company;
use rates::with_rates;
use reach::{looked_at, reach};
use tails::{OfImages, tails};

/// The part of the votes that is from farther away than objects are taken to be seen from. So many may be of another thing (`ODD`), and would make misses of
/// all looks up to where they are from.
const FAR_VOTES: f64 = 0.05;
/// Boxes that are all put on one elevation, as those of bearings are on the horizon, differ in its sine by no more than rounding.
const LEAST_ELEVATIONS: f64 = 1e-6;
/// Fewer of these tell nothing, and what was thought before stays. Of five a standard deviation is known no better than to a third.
const MIN_OBJECTS: usize = 5;
/// What is seen in less than this part of the looks that are usual is rather false than real. Objects that face another street are still seen in about half.
const HARDLY: f64 = 0.5;
/// The median absolute deviation of a normal distribution, in standard deviations.
const MAD_OF_NORMAL: f64 = 0.6745;
/// A spread of sizes is no smaller: boxes are whole pixels, and edges are not the same all around. A pixel is 3 % of a box of 33 px.
const LEAST_SPREAD: f64 = 0.03;

/// Learn the classes of a model from the objects that some rays make. Classes of few objects are taken to be like all objects together, but for how
/// much clutter there is.
pub fn learn(model: &mut Model<'_>, lookout: &Lookout, rays: &[u32], objects: &[Object]) {
    let evidence = Evidence::new(model, lookout, rays, objects);
    let all: Vec<&Object> = objects.iter().collect();
    let pooled = evidence.learned(&all, rays, &model.pooled, !model.pooled.is_learned);
    let is_only = |before: &ClassModel| model.classes.len() == 1 && has_same_numbers(before, &model.pooled);
    let classes: Vec<ClassModel> = (0..)
        .zip(&model.classes)
        .map(|(class, before)| {
            // All together are the only one.
            if pooled.is_learned && is_only(before) {
                return pooled;
            }
            let of_class: Vec<&Object> = all.iter().copied().filter(|object| object.class == class).collect();
            let rays: Vec<u32> = rays.iter().copied().filter(|&ray| model.scene.class_of(ray) == class).collect();
            let learned = evidence.learned(&of_class, &rays, before, false);
            if learned.is_learned { learned } else { pooled.with_own(&learned) }
        })
        .collect();
    (model.pooled, model.classes) = (pooled, classes);
}

/// How dense some detections are, 1/sr, in logarithms. One more than there are: no clutter at all is never known for sure.
fn ln_per_sr(clutter: usize, solid_angle_sr: f64) -> f64 {
    ((clutter + 1) as f64 / solid_angle_sr).ln()
}

/// Whether two classes are alike to the bit, what is no number as well.
fn has_same_numbers(a: &ClassModel, b: &ClassModel) -> bool {
    a.to_row().iter().map(|number| number.to_bits()).eq(b.to_row().iter().map(|number| number.to_bits()))
}

/// What classes are learned from.
struct Evidence<'a> {
    model: &'a Model<'a>,
    lookout: &'a Lookout,
    objects: &'a [Object],
    /// Whether each ray is a vote.
    is_vote: Vec<bool>,
    solid_angle_sr: f64,
    /// How dense the clutter of each class is.
    ln_clutter_per_sr: Vec<f64>,
    ground_m2: f64,
    looked_at: (f64, f64),
    /// Objects with fewer votes do not serve.
    least_votes: usize,
}

impl<'a> Evidence<'a> {
    fn new(model: &'a Model<'a>, lookout: &'a Lookout, rays: &[u32], objects: &'a [Object]) -> Self {
        let is_vote = are_taken(model.scene, objects);
        let solid_angle_sr = model.solid_angle_sr(rays.len());
        let mut clutter = vec![0; model.classes.len()];
        let of_none = rays.iter().filter(|&&ray| !is_vote[ray as usize]);
        of_none.for_each(|&ray| clutter[model.scene.class_of(ray) as usize] += 1);
        let ln_clutter_per_sr = clutter.into_iter().map(|clutter| ln_per_sr(clutter, solid_angle_sr)).collect();
        let sure = objects.iter().filter(|object| is_sure(object)).count();
        let looked_at = span(&model.sin_elevation);
        let are_elevations_measured = looked_at.1 - looked_at.0 > LEAST_ELEVATIONS;
        let least_votes = if sure < MIN_OBJECTS && are_elevations_measured { LEAST_VOTES } else { SURE_VOTES };
        Self {
            model,
            lookout,
            objects,
            is_vote,
            solid_angle_sr,
            ln_clutter_per_sr,
            ground_m2: ground_m2(model, objects, least_votes) * model.share_of(rays.len()),
            looked_at,
            least_votes,
        }
    }

    /// What objects and rays of a class tell. Where it `is_guessed` what is real, by how often objects are usually seen, and hardly anything is, the guess
    /// is wrong: then all that most passes meet tell.
    fn learned(&self, of_class: &[&Object], rays: &[u32], before: &ClassModel, is_guessed: bool) -> ClassModel {
        let model = self.model;
        let (in_class, clutter): (Vec<u32>, Vec<u32>) = rays.iter().partition(|&&ray| self.is_vote[ray as usize]);
        let mut learned = ClassModel { ln_clutter_per_sr: ln_per_sr(clutter.len(), self.solid_angle_sr), ..*before };
        let of = |column: &[f64], rays: &[u32]| rays.iter().map(|&ray| column[ray as usize]).collect::<Vec<f64>>();
        let has = |part: Part| model.settings.has(part);
        if has(Part::Scores) {
            learned.score_ratio = score_ratio(&of(&model.scene.score, &in_class), &of(&model.scene.score, &clutter));
        }
        if has(Part::Elevations) {
            let mut sigmas: Vec<f64> = clutter.iter().map(|&ray| far_sigma_rad(model, ray)).collect();
            let resolution = median(&mut sigmas).unwrap_or(0.0);
            learned.clutter_by_elevation =
                elevation_factor(&of(&model.sin_elevation, &clutter), self.looked_at, resolution);
        }
        let many: Vec<&Object> =
            of_class.iter().copied().filter(|object| object.votes.len() >= self.least_votes).collect();
        let mut sure: Vec<&Object> = many.iter().copied().filter(|object| object.real > 0.5).collect();
        if is_guessed && sure.len() < MIN_OBJECTS {
            sure = many.iter().copied().filter(|object| object.seen.is_met_by_most()).collect();
        }
        if sure.len() >= MIN_OBJECTS {
            learned.is_learned = true;
            learned = with_rates(&many, &learned, has(Part::Ghosts));
            learned.farthest_m = farthest_m(model, &sure);
            let (spread, object) = sizes(model, &sure);
            learned.sizes.spread = spread.max(LEAST_SPREAD);
            learned.sizes.object = (object.0, object.1.max(learned.sizes.spread));
            learned.heights = if has(Part::Heights) { heights(model, &sure) } else { None };
            learned.ln_births_per_m2 = (of_class.len() as f64 / self.ground_m2).ln();
            // False things have many looks and few hits: they would teach that objects are hardly seen, and then look real.
            let seen: Vec<&Object> = sure.iter().copied().filter(|object| !is_hardly_seen(object, &learned)).collect();
            let looked_at = looked_at(model, self.lookout, &seen, learned.farthest_m);
            if has(Part::Reach) {
                learned.reach = reach(model, &looked_at, learned.farthest_m);
            }
            if has(Part::Aspect) {
                learned.aspect = aspect(model, &looked_at);
            }
            if has(Part::Tails) {
                // What is hardly ever seen where it should be may be made of them.
                let hardly = of_class.iter().filter(|object| is_hardly_seen(object, &learned));
                let votes = hardly.flat_map(|object| object.votes.iter().copied());
                let free = OfImages::new(model.scene, clutter.iter().copied().chain(votes));
                learned.tails = tails(model, &looked_at, &free, &self.ln_clutter_per_sr);
            }
            if has(Part::Company) {
                learned.company = company(model, self.objects, &learned, of_class[0].class);
            }
        }
        learned
    }
}

/// Whether an object is rather false than real, as it is seen far less often than is usual.
fn is_hardly_seen(object: &Object, class: &ClassModel) -> bool {
    object.seen.share() < HARDLY * class.rates.recall
}

/// Whether an object has many votes, and is real rather than false.
pub(crate) fn is_sure(object: &Object) -> bool {
    object.votes.len() >= SURE_VOTES && object.real > 0.5
}

/// The ground from which objects are seen, m²: as far from the cameras as all but few votes are; nothing where nobody knows what is up.
fn ground_m2(model: &Model<'_>, objects: &[Object], least_votes: usize) -> f64 {
    let sure: Vec<&Object> = objects.iter().filter(|object| object.votes.len() >= least_votes).collect();
    let mut distances = distances_m(model, &sure);
    let place = (distances.len() as f64 * (1.0 - FAR_VOTES)) as usize;
    match model.up {
        Some(up) if place < distances.len() => {
            ground_m2_within(model.scene, &up, *distances.select_nth_unstable_by(place, f64::total_cmp).1)
        }
        _ => f64::NAN,
    }
}

/// How high objects are above the cameras.
fn heights(model: &Model<'_>, objects: &[&Object]) -> Option<Heights> {
    let up = model.up?;
    let of_object = |object: &&Object| {
        let height_m = height_m(model.scene, model.up, &object.votes, &object.fit.point)?;
        Some((height_m, up.dot(&(object.fit.covariance * up)).sqrt()))
    };
    let (heights_m, sigmas_m): (Vec<f64>, Vec<f64>) = objects.iter().filter_map(of_object).unzip();
    Heights::learn(&heights_m, &sigmas_m, model.settings.viability.max_range_m)
}

/// Standard deviation of the direction of a ray, each axis, rad.
fn far_sigma_rad(model: &Model<'_>, ray: u32) -> f64 {
    (model.spreads[ray as usize].far_px2 / model.scene.scale2[ray as usize]).sqrt()
}

/// The least and the greatest of some numbers, those that are not numbers aside.
fn span(numbers: &[f64]) -> (f64, f64) {
    numbers
        .iter()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(least, most), &number| (least.min(number), most.max(number)))
}

/// The distance up to which all but few votes are cast, m.
fn farthest_m(model: &Model<'_>, objects: &[&Object]) -> f64 {
    let mut distances = distances_m(model, objects);
    distances.sort_by(f64::total_cmp);
    let few = (distances.len() as f64 * FAR_VOTES) as usize;
    distances[distances.len() - 1 - few]
}

/// How far all votes are from their objects, m.
fn distances_m(model: &Model<'_>, objects: &[&Object]) -> Vec<f64> {
    let of_object = |object: &&Object| -> Vec<f64> {
        object.votes.iter().map(|&ray| (model.scene.ray(ray).center - object.fit.point).norm()).collect()
    };
    objects.iter().flat_map(of_object).collect()
}

/// The spread of the sizes of one object, and mean and standard deviation of those of all.
fn sizes(model: &Model<'_>, objects: &[&Object]) -> (f64, (f64, f64)) {
    let (mut away, mut medians) = (Vec::new(), Vec::new());
    for object in objects {
        let sizes = object.votes.iter().map(|&ray| implied_size(model, ray, &object.fit.point));
        let mut sizes: Vec<f64> = sizes.filter(|size| size.is_finite()).collect();
        if let Some(median) = median(&mut sizes) {
            away.extend(sizes.iter().map(|size| (size - median).abs()));
            medians.push(median);
        }
    }
    let spread = median(&mut away).unwrap_or(f64::NAN) / MAD_OF_NORMAL;
    let middle = median(&mut medians).unwrap_or(f64::NAN);
    for size in &mut medians {
        *size = (*size - middle).abs();
    }
    (spread, (middle, median(&mut medians).unwrap_or(f64::NAN) / MAD_OF_NORMAL))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::robust::energy::seen::Seen;
    use crate::robust::energy::{anywhere, object};
    use crate::robust::model::steps::Steps;
    use crate::street;
    use crate::street::SETTINGS;

    #[test]
    fn objects_of_few_votes_teach_only_where_there_are_no_others_and_elevations_are_measured() {
        let scene = street::street(12, 2.0, &[Vector3::new(30.0, 4.0, 3.0)], &[[0.0, 0.0]]);
        let mut model = Model::new(&scene, &street::NOISE, &SETTINGS);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let rays = scene.usable_rays();
        let few = |model: &Model<'_>, objects: &[Object]| Evidence::new(model, &lookout, &rays, objects).least_votes;
        let sure: Vec<Object> = (0..MIN_OBJECTS).map(|_| anywhere(SURE_VOTES, Seen::default(), -100.0)).collect();
        assert_eq!(few(&model, &sure), SURE_VOTES);
        assert_eq!(few(&model, &sure[1..]), LEAST_VOTES);
        // Bearings: all boxes are put on the horizon, but for rounding.
        for (i, sine) in model.sin_elevation.iter_mut().enumerate() {
            *sine = 1e-12 * (i % 3) as f64;
        }
        assert_eq!(few(&model, &sure[1..]), SURE_VOTES);
    }

    #[test]
    fn what_is_hardly_seen_does_not_teach_how_objects_are_seen() {
        let place =
            |i: usize| Vector3::new(70.0 + 3.0 * (i / 2) as f64, if i.is_multiple_of(2) { 8.0 } else { -8.0 }, 3.0);
        let all: Vec<Vector3<f64>> = (0..12).map(place).collect();
        let scene = street::street(90, 1.0, &all, &[[0.0; 2]]);
        let mut model = Model::new(&scene, &street::NOISE, &SETTINGS);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let rays = scene.usable_rays();
        // Those on the other side have a vote in each seventh image that shows them, and are thought to be real.
        let of = |i: usize| -> Option<Object> {
            let toward = |ray: u32| (all[i] - scene.ray(ray).center).normalize();
            let of_object = rays.iter().copied().filter(|&ray| (scene.ray(ray).direction - toward(ray)).norm() < 1e-6);
            let votes = of_object.step_by(if i.is_multiple_of(2) { 1 } else { 7 }).collect();
            Some(Object { real: 1.0, ..object(&model, &lookout, votes, all[i])? })
        };
        let objects: Vec<Object> = (0..all.len()).filter_map(of).collect();
        assert!(objects.iter().filter(|object| is_sure(object)).count() == all.len());
        learn(&mut model, &lookout, &rays, &objects);
        let least = model.classes[0].aspect.within_pass.concat().into_iter().fold(1.0, f64::min);
        assert!(least > 0.7, "{least}");
    }

    #[test]
    fn where_nothing_is_seen_as_often_as_was_guessed_all_objects_teach() {
        let all: Vec<Vector3<f64>> = (0..8).map(|i| Vector3::new(70.0 + 4.0 * f64::from(i), 5.0, 3.0)).collect();
        let scene = street::joined((0..3).map(|_| street::street(90, 1.0, &all, &[[0.0; 2]])).collect());
        let mut model = Model::new(&scene, &street::NOISE, &SETTINGS);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let usable = scene.usable_rays();
        // One image in seven detects what is there.
        let of = |i: usize| -> Vec<u32> {
            let toward = |ray: u32| (all[i] - scene.ray(ray).center).normalize();
            let of_object =
                usable.iter().copied().filter(|&ray| (scene.ray(ray).direction - toward(ray)).norm() < 1e-6);
            of_object.skip(i).step_by(7).collect()
        };
        let mut rays: Vec<u32> = (0..all.len()).flat_map(of).collect();
        rays.sort_unstable();
        let map = |model: &Model<'_>| -> Vec<Object> {
            (0..all.len()).filter_map(|i| object(model, &lookout, of(i), all[i])).collect()
        };
        let guessed = map(&model);
        assert!(guessed.len() == all.len() && !guessed.iter().any(is_sure));
        learn(&mut model, &lookout, &rays, &guessed);
        assert!((model.pooled.rates.recall - 1.0 / 7.0).abs() < 0.05, "{:?}", model.pooled.rates);
        assert!(map(&model).iter().all(|object| is_sure(object) && object.energy < 0.0));
    }

    #[test]
    fn the_only_class_is_all_classes_together() {
        let errors: Vec<[f64; 2]> = (0..97).map(|i| [(f64::from(i) * 1.7).sin(), (f64::from(i) * 2.3).cos()]).collect();
        let all: Vec<Vector3<f64>> = (0..6).map(|i| Vector3::new(25.0 + 3.0 * f64::from(i), 4.0, 3.0)).collect();
        let scene = street::joined((0..3).map(|i| street::street(12, 2.0, &all, &errors[7 * i..])).collect());
        let mut model = Model::new(&scene, &street::NOISE, &SETTINGS);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let rays = scene.usable_rays();
        let votes = |i: usize| rays.iter().copied().skip(i).step_by(all.len()).collect();
        let objects: Vec<Object> = (0..all.len()).filter_map(|i| object(&model, &lookout, votes(i), all[i])).collect();
        let by_itself = {
            let evidence = Evidence::new(&model, &lookout, &rays, &objects);
            evidence.learned(&objects.iter().collect::<Vec<_>>(), &rays, &model.classes[0], true)
        };
        learn(&mut model, &lookout, &rays, &objects);
        assert!(by_itself.is_learned && has_same_numbers(&model.classes[0], &by_itself));
        assert!(has_same_numbers(&model.pooled, &by_itself));
    }

    #[test]
    fn a_rare_class_is_like_all_together_each_time_that_it_is_learned() {
        let all: Vec<Vector3<f64>> = (0..8).map(|i| Vector3::new(25.0 + 3.0 * f64::from(i), 4.0, 3.0)).collect();
        let mut scene =
            street::joined((0..3).map(|_| street::street(12, 2.0, &all, &[[0.3, -0.2], [-0.1, 0.4]])).collect());
        let rays = scene.usable_rays();
        let of_last = rays.iter().copied().skip(all.len() - 1).step_by(all.len());
        let class = &mut std::sync::Arc::make_mut(&mut scene.rays).class;
        of_last.for_each(|ray| class[ray as usize] = 1);
        let mut model = Model::new(&scene, &street::NOISE, &SETTINGS);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let votes = |i: usize| rays.iter().copied().skip(i).step_by(all.len()).collect();
        for _ in 0..2 {
            let found = (0..all.len()).filter_map(|i| object(&model, &lookout, votes(i), all[i]));
            let objects: Vec<Object> = found.map(|object| Object { real: 1.0, ..object }).collect();
            learn(&mut model, &lookout, &rays, &objects);
            assert!(model.pooled.is_learned && !model.classes[1].is_learned);
            assert_eq!(model.classes[1].rates, model.pooled.rates);
            assert_eq!(model.classes[1].company, Steps::NONE);
            // It is seen from as far as others are.
            let seen = lookout.looks(&model, &all[7], &votes(7));
            assert!(seen.sectors.concat().iter().any(|looks| looks.expected > 0.0));
        }
    }
}
