//! Objects of one or two votes, which their rays alone do not fix: equations (6) to (8) of `docs/method.md`.
//!
//! An unassigned ray is explained by an object where objects of its class stand: at their height, of their size, as far away as they are detected or as
//! was measured. Its covariance is that of the ray, with heights and sizes as observations. The energy is that of every object, and three terms more: the
//! density of clutter at the elevation of the ray, how near sure objects are, and how many objects of so few votes there can be.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::assign::gain_alone;
use crate::progress::{Halt, Progress};
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::seen::Shares;
use crate::robust::energy::{Object, are_taken, by_place, object, unseen};
use crate::robust::learn::company::Sure;
use crate::robust::model::{ClassModel, Model};
use crate::robust::noise::index::RayIndex;

/// Places along a ray that are compared: so many to a factor of ten in distance are 8 % apart, less than what sizes tell.
const PLACES_PER_DECADE: f64 = 30.0;
/// What is less probable than one in a hundred is not asked about: even all of it would be few.
const LEAST_LN_ODDS: f64 = -4.6;
/// Times that an object gathers votes and is estimated again, at most. They are fewer than for a birth (`births`), as there are few votes to gather.
pub(super) const ROUNDS: usize = 3;

/// The objects that rays of no other object make, the surest first; those with fewer votes than `least_votes` aside.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn objects_of_few(
    model: &Model<'_>,
    lookout: &Lookout,
    rays: &[u32],
    objects: &[Object],
    least_votes: usize,
    progress: &Progress,
) -> Result<Vec<Object>, Halt> {
    let mut is_taken = are_taken(model.scene, objects);
    let tells = |ray: u32| model.class_of(ray).heights.is_some() || model.has_range(ray);
    let is_free = |ray: &u32| !is_taken[*ray as usize] && tells(*ray);
    let free: Vec<u32> = rays.iter().copied().filter(is_free).collect();
    let index = RayIndex::new(model.scene, &model.spreads, model.settings.gate_sigmas, free.iter().copied());
    let beside = Beside::new(model, objects);
    let sure = Sure::of_classes(model, objects);
    let nursery = Nursery { model, lookout, index: &index, beside: &beside, sure: &sure };
    let begin = |&ray: &u32| {
        progress.check()?;
        Ok(nursery.grown(ray, &|_| true).map(|object| (object, ray)))
    };
    let grown: Vec<Option<(Object, u32)>> = free.par_iter().map(begin).collect::<Result<_, Halt>>()?;
    let mut grown: Vec<(Object, u32)> = grown.into_iter().flatten().collect();
    grown.sort_by(|a, b| a.0.energy.total_cmp(&b.0.energy).then(a.1.cmp(&b.1)));
    let mut found: Vec<Object> = Vec::new();
    for (object, ray) in grown {
        progress.check()?;
        if is_taken[ray as usize] {
            continue;
        }
        let is_whole = object.votes.iter().all(|&vote| !is_taken[vote as usize]);
        let left = if is_whole { Some(object) } else { nursery.grown(ray, &|vote| !is_taken[vote as usize]) };
        if let Some(object) = left {
            object.votes.iter().for_each(|&vote| is_taken[vote as usize] = true);
            found.push(object);
        }
    }
    found.retain(|object| object.votes.len() >= least_votes);
    add_odds(model, &mut found);
    Ok(found)
}

/// Add to J of objects what their numbers of votes say, equation (8).
pub(crate) fn add_odds(model: &Model<'_>, objects: &mut [Object]) {
    for object in objects {
        object.energy -= 2.0 * ln_odds(&model.classes[object.class as usize], object.votes.len());
    }
}

/// How much more probable, in logarithms, what [`most_probable`] rather than its rays found is by the terms that J has for such objects alone: equations
/// (6) to (8).
pub(crate) fn ln_terms(model: &Model<'_>, sure: &[Sure], object: &Object) -> f64 {
    let density = ln_density(model, &sure[object.class as usize], object.class, &object.votes, &object.fit.point);
    density + ln_odds(&model.classes[object.class as usize], object.votes.len())
}

/// How much denser objects of a class are at a place, with the company they have there, than clutter is at the elevations of some rays, in logarithms.
fn ln_density(model: &Model<'_>, sure: &Sure, class: u32, votes: &[u32], place: &Vector3<f64>) -> f64 {
    let learned = &model.classes[class as usize];
    let sines = votes.iter().map(|&vote| model.sin_elevation[vote as usize]);
    let clutter: f64 = sines.map(|sine| learned.clutter_by_elevation.at(sine)).sum();
    learned.company.at(sure.nearness(place, None)) - clutter
}

/// Logarithm of the odds of objects of so many votes, among what is left.
fn ln_odds(class: &ClassModel, votes: usize) -> f64 {
    class.ln_odds_of_few[votes.min(class.ln_odds_of_few.len()) - 1]
}

/// The objects that are there.
struct Beside<'a> {
    objects: &'a [Object],
    tree: rstar::RTree<rstar::primitives::GeomWithData<[f64; 3], usize>>,
    reach_m: f64,
}

impl<'a> Beside<'a> {
    fn new(model: &Model<'_>, objects: &'a [Object]) -> Self {
        Self { objects, tree: by_place(objects), reach_m: model.settings.viability.max_range_m }
    }

    /// Whether votes at a place may be of an object that is there, and that has no other detection in their images.
    fn explains(&self, model: &Model<'_>, object: &Object) -> bool {
        let sigma = object.fit.covariance.trace().sqrt();
        let reach = (model.settings.gate_sigmas * 2.0 * sigma).min(self.reach_m);
        let near = self.tree.locate_within_distance(object.fit.point.into(), reach * reach);
        near.map(|near| &self.objects[near.data]).any(|other| {
            let apart = other.fit.point - object.fit.point;
            let covariance = other.fit.covariance + object.fit.covariance;
            let is_near = covariance
                .cholesky()
                .is_none_or(|cholesky| apart.dot(&cholesky.solve(&apart)) <= model.settings.gate_chi2());
            model.confusions.may_be(other.class, object.class) && is_near && !object.is_seen_beside(model.scene, other)
        })
    }
}

/// Where objects grow from a ray.
struct Nursery<'a> {
    model: &'a Model<'a>,
    lookout: &'a Lookout,
    index: &'a RayIndex<'a>,
    beside: &'a Beside<'a>,
    sure: &'a [Sure],
}

impl Nursery<'_> {
    /// The object of a ray and of the free rays that explain it better; nothing if none stands on it, or one that is there explains it.
    fn grown(&self, ray: u32, may_vote: &dyn Fn(u32) -> bool) -> Option<Object> {
        let model = self.model;
        let class = model.class_of(ray);
        let alone = unseen(model, vec![ray], most_probable(model, ray, class)?)?;
        let (votes, gain) = votes_on(model, self.index, &alone, ray, may_vote);
        // Before it is estimated with all of them, which takes most of the time.
        if !self.may_be(class, &alone, &votes, gain) {
            return None;
        }
        let mut best = self.joined(alone, ray, votes, may_vote)?;
        best.energy -= 2.0 * self.ln_density(best.class, &best.votes, &best.fit.point);
        (!self.beside.explains(model, &best)).then_some(best)
    }

    /// The object that one of a ray alone becomes with the other votes that it may have, with those who should have seen it.
    fn joined(&self, alone: Object, ray: u32, mut votes: Vec<u32>, may_vote: &dyn Fn(u32) -> bool) -> Option<Object> {
        let model = self.model;
        let mut best = alone.with_looks(model, self.lookout)?;
        for _ in 0..ROUNDS {
            if votes == best.votes {
                break;
            }
            match object(model, self.lookout, votes, best.fit.point) {
                Some(more) if more.energy < best.energy => best = more,
                _ => break,
            }
            votes = votes_on(model, self.index, &best, ray, may_vote).0;
        }
        Some(best)
    }

    /// Whether an object of some votes may be there, about where one of them alone stands. They are worth no more together than each is to that one.
    fn may_be(&self, class: &ClassModel, alone: &Object, votes: &[u32], gain: f64) -> bool {
        let density = self.ln_density(alone.class, votes, &alone.fit.point);
        let at_most = ln_odds(class, votes.len()) + density - 0.5 * alone.energy + gain;
        if at_most <= LEAST_LN_ODDS {
            return false;
        }
        let seen = self.lookout.looks(self.model, &alone.fit.point, votes);
        let judged = seen.judged(&Shares::of(class));
        at_most + judged.ln_likelihood() > LEAST_LN_ODDS && judged.real().ln() > LEAST_LN_ODDS
    }

    fn ln_density(&self, class: u32, votes: &[u32], place: &Vector3<f64>) -> f64 {
        ln_density(self.model, &self.sure[class as usize], class, votes, place)
    }
}

/// Where an object of a class most probably is on a ray: as high and as large as others, and as far away as measured; nothing where neither heights nor
/// ranges tell.
pub(crate) fn most_probable(model: &Model<'_>, ray: u32, class: &ClassModel) -> Option<Vector3<f64>> {
    let heights = class.heights.as_ref().zip(model.up);
    if heights.is_none() && !model.has_range(ray) {
        return None;
    }
    let cast = model.scene.ray(ray);
    let of_one_m = cast.project(&(cast.center + cast.direction)).z;
    let ln_angle = model.ln_angle[ray as usize];
    let (mean, sd) = class.sizes.object;
    let sd = sd.hypot(class.sizes.spread);
    let ln_density = |distance_m: f64| {
        let away = (ln_angle + distance_m.ln() - mean) / sd;
        let of_size = if class.sizes.tell() && away.is_finite() { -0.5 * away * away } else { 0.0 };
        let of_height = heights.map_or(0.0, |(heights, up)| heights.ln_density(cast.direction.dot(&up) * distance_m));
        let of_range = model.ln_range_ratio(ray, distance_m * of_one_m);
        of_height + 2.0 * distance_m.ln() + of_size + of_range
    };
    let nearest_m = model.settings.viability.min_range_m.max(class.farthest_m * 1e-3);
    let steps = ((class.farthest_m / nearest_m).log10() * PLACES_PER_DECADE).ceil().max(1.0);
    let places = (0..=steps as usize).map(|i| nearest_m * (class.farthest_m / nearest_m).powf(i as f64 / steps));
    let best = places.map(|distance_m| (ln_density(distance_m), distance_m));
    let (_, distance_m) = best.max_by(|a, b| a.0.total_cmp(&b.0))?;
    Some(cast.center + cast.direction * distance_m)
}

/// A ray, and those that an object on it has from other images, one of each; and how much more probable each of these is than clutter, in
/// logarithms, added up.
pub(crate) fn votes_on(
    model: &Model<'_>,
    index: &RayIndex<'_>,
    object: &Object,
    ray: u32,
    may_vote: &dyn Fn(u32) -> bool,
) -> (Vec<u32>, f64) {
    let image = model.scene.image_of(ray);
    let may_be = |said| model.confusions.may_be(object.class, said);
    let hits = index.hits_of_any(&object.places(model), &may_be, model.class_of(ray).farthest_m);
    let mut others: Vec<(u32, f64, u32)> = hits
        .into_iter()
        .filter(|hit| hit.image != image && may_vote(hit.ray))
        .map(|hit| (hit.image, gain_alone(model, object, hit.ray), hit.ray))
        .filter(|(_, gain, _)| *gain > 0.0)
        .collect();
    others.sort_by(|a, b| a.0.cmp(&b.0).then(b.1.total_cmp(&a.1)).then(a.2.cmp(&b.2)));
    others.dedup_by_key(|vote| vote.0);
    let gain = others.iter().map(|vote| vote.1).sum();
    let mut votes: Vec<u32> = others.into_iter().map(|vote| vote.2).chain([ray]).collect();
    votes.sort_unstable();
    (votes, gain)
}
