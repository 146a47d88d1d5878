//! The robust method: one energy J, and a search for the map with the least.
//!
//! 1. [`scene`], [`noise`], [`model`]: what was seen, its errors, and what is learned about each class.
//! 2. [`likeliest`], [`calibrate`], [`split`](mod@split): the noise, by restricted maximum likelihood. [`agreement`]: what passes and [`sides`](mod@sides) of
//!    objects disagree about. [`learn`](mod@learn), [`confusion`]: the classes.
//! 3. [`propose`](mod@propose): each ray meets few partners ([`sample`]) and proposes the point that a sample of images supports best.
//!    [`initial`]: the map that the search begins with.
//! 4. [`search`](mod@search): moves that are committed only if J ([`energy`]) falls. [`assign`](mod@assign): all detections of an image.
//!    [`rearrange`]: merges and exchanges of two objects. [`repair`](mod@repair): neighbourhoods. [`births`](mod@births), [`regrow`](mod@regrow): births.
//!    [`untangle`](mod@untangle): which of two neighbours is which.
//! 5. [`finish`](mod@finish): positions and covariances, objects of a place together ([`estimate`](mod@estimate), [`drift`], [`contest`]).
//! 6. [`few`]: objects of one or two votes. [`existence`]: which objects exist. [`switches`]: identity switches are left out.

pub mod agreement;
pub mod aspect;
pub mod assign;
pub mod births;
pub mod calibrate;
pub mod clutter;
pub mod company;
pub mod confusion;
pub mod contest;
pub mod counts;
pub mod drift;
pub mod energy;
pub mod estimate;
pub mod existence;
pub mod few;
pub mod finish;
mod foresee;
pub mod heights;
pub mod index;
pub mod initial;
pub mod keyframes;
pub mod learn;
pub mod likeliest;
pub mod looks;
pub mod model;
pub mod noise;
pub mod parts;
pub mod poses;
pub mod prior;
pub mod propose;
pub mod quick;
pub mod ranges;
pub mod reach;
pub mod rearrange;
pub mod regrow;
pub mod repair;
pub mod sample;
pub mod scene;
pub mod search;
pub mod seen;
pub mod sides;
pub mod sizes;
mod spd;
pub mod split;
pub mod switches;
pub mod tails;
pub mod untangle;

use std::sync::Arc;

use crate::hypothesis::Viability;
use crate::progress::{Halt, Progress};

use calibrate::{Known, Placed};
use confusion::Confusions;
use energy::{Object, object};
use estimate::Estimate;
use finish::finish;
use index::RayIndex;
use learn::learn;
use likeliest::likeliest_noise;
use looks::Lookout;
use model::{ClassModel, Model, Rates};
use noise::{Noise, Spread};
use parts::{Part, Without};
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};
use scene::Scene;
use search::{Depth, search};
use switches::are_others;

/// Settings of the robust method.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// Which pairs propose points; the error in pixels is not used.
    pub viability: Viability,
    /// The gate, in sigmas.
    pub gate_sigmas: f64,
    /// Labels with fewer voters are dropped.
    pub min_votes: u32,
    /// Objects of which heights are known need no more than so many.
    pub least_votes: u32,
    /// Labels that exist with a smaller probability are dropped.
    pub min_existence: f64,
    /// Parts that are left out, to see what they are worth.
    pub without: Without,
}

impl Settings {
    /// Whether a part of the method is in use.
    #[inline]
    #[must_use]
    pub const fn has(&self, part: Part) -> bool {
        !self.without.has(part)
    }
}

/// Rays of the places that the noise is estimated from, about: from each start, and from the best in the end.
const CALIBRATION_RAYS: (usize, usize) = (4_000, 10_000);
/// Rays that classes are learned from, about: some hundred objects of some hundred votes each. Of fifty, a few that are hardly seen tell whether the
/// others are seen alike.
const CLASS_RAYS: usize = 30_000;
/// Places that classes are learned from are so many ranges wide: most objects in them are seen by no other images.
const WIDE: f64 = 3.0;
/// Scenes with more rays than this are searched less deeply, if that changes little.
const MOST_RAYS: usize = 100_000;
/// All moves take some ten times as long: they pay if they change more than one object in ten of those that are kept.
const LEAST_CHANGE: f64 = 0.1;
/// By so many standard deviations of the share more: what a sample says by chance pays nowhere.
const LEAST_CHANGE_SIGMAS: f64 = 2.0;
/// Below so many expected changes the normal distribution says nothing of their number.
const LEAST_EXPECTED: f64 = 5.0;
/// It is asked of so many parts of the places that classes are learned from, one after the other, until they tell: a part has some twenty objects.
const PARTS_OF_PLACES: usize = 5;

/// Steps of [`self_calibrate`] at most, as progress counts them, but for the search that tells whether all moves pay: the noise, and the classes.
pub const CALIBRATION_STEPS: usize = likeliest::NOISE_STEPS + likeliest::MIDDLES_ROUNDS + 1;

/// What is estimated once of a scene, or of a sample of it, before any part of it is mapped.
#[derive(Debug, Clone)]
pub struct Calibration {
    /// Errors of poses and detections.
    pub noise: Noise,
    /// What is learned of each class; nothing of those that are nowhere in the sample.
    pub classes: Vec<Option<ClassModel>>,
    /// What is learned of all classes together: what others are like.
    pub pooled: ClassModel,
    /// Which classes are taken for which.
    pub confusions: Confusions,
    /// Whether all moves pay, from all images.
    pub is_deep: bool,
    /// From how many starts the noise was sought; 0 if it was known.
    pub starts: usize,
}

/// A label with what speaks for it.
#[derive(Debug, Clone)]
pub struct Finding {
    /// Position and covariance.
    pub estimate: Estimate,
    /// Its class: that of most of its votes, but for confusions.
    pub class: u32,
    /// The rays that vote for it, ascending.
    pub votes: Vec<u32>,
    /// Probability that it exists.
    pub existence: f64,
    /// Images that should have seen it.
    pub expected: u32,
}

/// What became of everything that was proposed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Tally {
    /// Points proposed by rays.
    pub hypotheses: u64,
    /// Objects that were born.
    pub births: u64,
    /// Objects that were not worth it in the end.
    pub deaths: u64,
}

/// The labels of a scene, and what became of the rest.
#[derive(Debug, Clone)]
pub struct Findings {
    /// Labels, ordered by their lowest vote.
    pub findings: Vec<Finding>,
    /// How it came to them.
    pub tally: Tally,
    /// What was learned about detection rates.
    pub rates: Rates,
    /// Detections per image that no label has.
    pub clutter_per_image: f64,
    /// J of the map.
    pub energy: f64,
    /// What the covariances were multiplied by, so that the passes agree.
    pub variance_factor: f64,
}

/// Estimate the noise from the data, starting from a guess: labels of a sample of places with the noise as it is thought
/// to be, then the noise that makes their residuals most likely, and again. `known` parts stay as they are. Then learn the classes.
/// All moves pay where a scene is small; if it `is_part` of a larger one, where they change the map of a sample.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn self_calibrate(
    scene: &Scene,
    guess: &Noise,
    known: Known,
    settings: &Settings,
    is_part: bool,
    progress: &Progress,
) -> Result<Calibration, Halt> {
    let more = sample::places(scene, CALIBRATION_RAYS.1, settings.viability.max_range_m);
    let is_known = known.detection && known.position && known.rotation;
    let (noise, starts) =
        if is_known { (*guess, 0) } else { likeliest_noise(scene, guess, known, settings, &more, progress)? };
    let mut model = Model::new(scene, &noise, settings);
    let wide = sample::places(scene, CLASS_RAYS, WIDE * settings.viability.max_range_m);
    let objects = learn_from(&mut model, &wide, progress)?;
    let noise = if settings.has(Part::NoiseSplit) { split::split(&model, known, &objects) } else { noise };
    let noise = if settings.has(Part::Sides) && !known.side {
        likeliest::with_middles(scene, &noise, known, settings, &placed(&objects), &wide, progress)?
    } else {
        noise
    };
    let noise = if settings.has(Part::SharedNoise) || is_known { noise } else { noise.all_own() };
    let is_small = !is_part && scene.usable_rays().len() <= MOST_RAYS;
    let is_deep = is_small || all_moves_pay(&mut model, &objects, progress)?;
    let classes = model.classes.iter().copied().map(Some).collect();
    Ok(Calibration { noise, classes, pooled: model.pooled, confusions: model.confusions, is_deep, starts })
}

/// Whether all moves change many objects of the places that classes are learned from, of which the map is known.
fn all_moves_pay(model: &mut Model<'_>, objects: &[Object], progress: &Progress) -> Result<bool, Halt> {
    let (mut change, mut asked) = (Change::default(), Vec::new());
    for part in 1..=PARTS_OF_PLACES {
        let more = sample::places(
            model.scene,
            CLASS_RAYS * part / PARTS_OF_PLACES,
            WIDE * model.settings.viability.max_range_m,
        );
        let rays: Vec<u32> = more.iter().copied().filter(|ray| asked.binary_search(ray).is_err()).collect();
        change.add(changed(model, &rays, objects, progress)?);
        if let Some(is_much) = change.is_much() {
            return Ok(is_much);
        }
        asked = more;
    }
    Ok(false)
}

/// How many objects of some places (their rays, ascending) all moves change. Rays of objects that have others as well stay out, and so do drives
/// where there are many.
fn changed(model: &mut Model<'_>, rays: &[u32], objects: &[Object], progress: &Progress) -> Result<Change, Halt> {
    let is_whole = |object: &&Object| object.votes.iter().all(|ray| rays.binary_search(ray).is_ok());
    let (whole, partly): (Vec<&Object>, Vec<&Object>) = objects.iter().partition(is_whole);
    let elsewhere: FxHashSet<u32> = partly.iter().flat_map(|object| &object.votes).copied().collect();
    let left = rays.iter().copied().filter(|ray| !elsewhere.contains(ray)).collect();
    let rays = sample::passes(model.scene, left, CLASS_RAYS);
    let votes_here =
        |object: &Object| object.votes.iter().copied().filter(|ray| rays.binary_search(ray).is_ok()).collect();
    let begun = whole.iter().map(|object| (votes_here(object), object.fit.point));
    let begun = begun.filter(|(votes, _): &Placed| votes.len() >= model.settings.min_votes as usize).collect();
    let once = search(model, &rays, begun, Depth::Once, false, &mut Tally::default(), progress)?;
    let deeper = search(model, &rays, placed(&once), Depth::Deep, false, &mut Tally::default(), progress)?;
    Ok(Change::of(&once, &deeper, model.settings.min_existence))
}

/// How many objects of two maps of the same rays are in both.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Change {
    kept: usize,
    /// Of both maps together.
    objects: usize,
}

impl Change {
    /// An object is in both maps if most of its votes are most of those of one of the other map. What exists less probably than `min_existence` is in
    /// no map that a user sees, and does not count.
    fn of(some: &[Object], others: &[Object], min_existence: f64) -> Self {
        let shown = |objects: &[Object]| -> Vec<Vec<u32>> {
            let likely = objects.iter().filter(|object| object.existence() >= min_existence);
            likely.map(|object| object.votes.clone()).collect()
        };
        let (some, others) = (shown(some), shown(others));
        let owner: FxHashMap<u32, usize> =
            others.iter().enumerate().flat_map(|(i, votes)| votes.iter().map(move |&ray| (ray, i))).collect();
        let is_kept = |votes: &&Vec<u32>| {
            let mut of: Vec<usize> = votes.iter().filter_map(|ray| owner.get(ray).copied()).collect();
            of.sort_unstable();
            let is_most = |shared: &[usize]| 2 * shared.len() > votes.len().max(others[shared[0]].len());
            of.chunk_by(|a, b| a == b).any(is_most)
        };
        Self { kept: some.iter().filter(is_kept).count(), objects: some.len() + others.len() }
    }

    fn add(&mut self, other: Self) {
        self.kept += other.kept;
        self.objects += other.objects;
    }

    /// Whether many objects are not in both; nothing if that may be chance.
    fn is_much(self) -> Option<bool> {
        let count = self.objects as f64;
        if count * LEAST_CHANGE < LEAST_EXPECTED {
            return None;
        }
        let chance = (LEAST_CHANGE * (1.0 - LEAST_CHANGE) / count).sqrt();
        let more = 1.0 - 2.0 * self.kept as f64 / count - LEAST_CHANGE;
        (more.abs() > LEAST_CHANGE_SIGMAS * chance).then_some(more > 0.0)
    }
}

/// Learn the classes of a model from the map of some rays, and return that. Where classes are taken for each other, all competes once more.
fn learn_from(model: &mut Model<'_>, rays: &[u32], progress: &Progress) -> Result<Vec<Object>, Halt> {
    let begun = initial::labels_of_few(model, rays, progress)?;
    let mut objects = search(model, rays, begun, Depth::Shallow, true, &mut Tally::default(), progress)?;
    let lookout = Lookout::new(model.scene, model.settings.viability.max_range_m);
    learn(model, &lookout, rays, &objects);
    if model.classes.len() > 1 && model.settings.has(Part::Confusions) {
        let spreads = Arc::clone(&model.spreads);
        let index = RayIndex::new(model.scene, &spreads, model.settings.gate_sigmas, rays.iter().copied());
        model.confusions = Confusions::learn(model, &lookout, &index, &objects);
        if model.confusions.is_any() {
            objects = search(model, rays, placed(&objects), Depth::Shallow, true, &mut Tally::default(), progress)?;
            learn(model, &lookout, rays, &objects);
        }
    }
    let few = few::objects_of_few(model, &lookout, rays, &objects, 1, progress)?;
    let [whole, mut whole_of_few] = {
        let is_whole = lookout.whole(model, rays);
        [&objects, &few].map(|all| all.iter().filter(|object| is_whole(object)).cloned().collect::<Vec<Object>>())
    };
    counts::learn_counts(model, &whole, &whole_of_few);
    few::add_odds(model, &mut whole_of_few);
    existence::learn_existence(model, &whole, &whole_of_few);
    Ok(objects)
}

/// Find the labels of a scene with what is estimated of it.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn find(
    scene: &Scene,
    calibration: &Calibration,
    settings: &Settings,
    progress: &Progress,
) -> Result<Findings, Halt> {
    let rays = scene.usable_rays();
    let noise = &calibration.noise;
    let mut model = Model::new(scene, noise, settings);
    model.know(&calibration.classes, calibration.pooled, &calibration.confusions);
    let (begun, first) = initial::labels(&model, !calibration.is_deep, progress)?;
    progress.advance()?;
    let mut tally =
        Tally { hypotheses: first.nominations, births: first.accepted, deaths: first.pruned + first.outvoted };
    let depth = if calibration.is_deep { Depth::Deep } else { Depth::Once };
    let objects = search(&mut model, &rays, begun, depth, false, &mut tally, progress)?;
    let estimates = finish(&model, &objects);
    let variance_factor = if settings.has(Part::Scaling) {
        agreement::variance_factor(scene, noise, &placed(&objects), objects.len().max(1))
    } else {
        1.0
    };
    let claimed: usize = objects.iter().map(|object| object.votes.len()).sum();
    let energy = objects.iter().map(|object| object.energy).sum();
    let lookout = Lookout::new(scene, settings.viability.max_range_m);
    let few = if settings.least_votes < settings.min_votes {
        few::objects_of_few(&model, &lookout, &rays, &objects, settings.least_votes as usize, progress)?
    } else {
        Vec::new()
    };
    let existences = existence::existences(&model, &objects, &few);
    let few = few.into_iter().map(|object| {
        let estimate = Estimate { point: object.fit.point, covariance: object.fit.covariance };
        (object, estimate)
    });
    let scaled = |estimate: Estimate| Estimate { covariance: estimate.covariance * variance_factor, ..estimate };
    let all: Vec<(Object, Estimate)> = objects.into_iter().zip(estimates.into_iter().map(scaled)).chain(few).collect();
    let are_others = are_others(&model, &all.iter().map(|(object, _)| object).collect::<Vec<_>>());
    tally.deaths += are_others.iter().filter(|is_other| **is_other).count() as u64;
    let mut findings: Vec<Finding> = all
        .into_iter()
        .zip(existences)
        .zip(are_others)
        .filter_map(|(one, is_other)| (!is_other).then_some(one))
        .map(|((object, estimate), existence)| (existence, object, estimate))
        .filter(|(existence, ..)| *existence >= settings.min_existence)
        .map(|(existence, object, estimate)| {
            let expected = lookout.expected(scene, &estimate.point, &object.votes);
            Finding { estimate, class: object.class, existence, expected, votes: object.votes }
        })
        .collect();
    findings.sort_by_key(|finding| finding.votes[0]);
    Ok(Findings {
        findings,
        tally,
        rates: model.classes.first().map_or(Rates::GUESS, |class| class.rates),
        clutter_per_image: (rays.len() - claimed) as f64 / scene.views.len() as f64,
        energy,
        variance_factor,
    })
}

/// The spread of every ray.
#[must_use]
pub fn spreads_of(scene: &Scene, noise: &Noise) -> Vec<Spread> {
    (0..scene.rays.rays.len() as u32).into_par_iter().map(|ray| noise.total(scene, ray)).collect()
}

/// Votes and positions of objects.
fn placed(objects: &[Object]) -> Vec<Placed> {
    objects.iter().map(|object| (object.votes.clone(), object.fit.point)).collect()
}

/// The objects that votes (ascending) with positions nearby make: as they are, or what a search from them ends at. For tests and diagnoses.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn objects_of(
    scene: &Scene,
    noise: &Noise,
    settings: &Settings,
    begun: Vec<Placed>,
    is_searched: bool,
    progress: &Progress,
) -> Result<Vec<Object>, Halt> {
    let rays = scene.usable_rays();
    let mut model = Model::new(scene, noise, settings);
    if is_searched {
        return search(&mut model, &rays, begun, Depth::Deep, true, &mut Tally::default(), progress);
    }
    let lookout = Lookout::new(scene, settings.viability.max_range_m);
    let objects: Vec<Object> =
        begun.into_iter().filter_map(|(votes, point)| object(&model, &lookout, votes, point, Vec::new())).collect();
    learn(&mut model, &lookout, &rays, &objects);
    let index = RayIndex::new(scene, &model.spreads, settings.gate_sigmas, rays.into_iter());
    let claims = assign::claims_of_all(&model, &index, &objects, progress)?;
    let again = |(o, claims): (Object, Vec<assign::Claim>)| {
        object(&model, &lookout, o.votes, o.fit.point, assign::images_of(&claims))
    };
    Ok(objects.into_iter().zip(claims).filter_map(again).collect())
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix3;

    use super::*;

    fn with_votes(first: u32, count: u32) -> Object {
        let fit = energy::Fit {
            point: nalgebra::Vector3::zeros(),
            covariance: Matrix3::identity(),
            energy: 0.0,
            chi2: Vec::new(),
            shown: Vec::new(),
        };
        let (ln_size, others, seen) = (f64::NAN, Vec::new(), seen::Seen::default());
        let votes = (first..first + count).collect();
        Object { class: 0, votes, fit, ln_size, others, seen, real: 1.0, energy: -100.0 }
    }

    #[test]
    fn all_moves_pay_if_they_change_more_than_one_object_in_ten_and_that_is_no_chance() {
        let some: Vec<Object> = (0..100).map(|i| with_votes(10 * i, 10)).collect();
        // Each of the first is two halves: none of them is what it was.
        let halved = |count: u32| -> Vec<Object> {
            (0..100)
                .flat_map(|i| {
                    let parts = if i < count { vec![(0, 5), (5, 5)] } else { vec![(0, 10)] };
                    parts.into_iter().map(move |(first, votes)| with_votes(10 * i + first, votes))
                })
                .collect()
        };
        let changed = |some: &[Object], others: &[Object]| Change::of(some, others, 0.55).is_much();
        assert_eq!(changed(&some, &some), Some(false));
        // 24 of 208 are 11.5 %, with a standard deviation of 2.1 %.
        assert_eq!(changed(&some, &halved(8)), None);
        assert!(changed(&some, &halved(12)) == Some(true) && changed(&halved(12), &some) == Some(true));
        // 27 of 209 are 12.9 %, with a standard deviation of 2.1 %: one part does not tell, three do.
        let part = Change::of(&some, &halved(9), 0.55);
        let mut parts = Change::default();
        (0..3).for_each(|_| parts.add(part));
        assert_eq!((part.is_much(), parts.is_much()), (None, Some(true)));
        // Where hardly anything is found, it is no change that hardly anything is in both.
        assert_eq!((changed(&[], &[]), changed(&some[..1], &some[1..20])), (None, None));
        // What only all moves find, and is in no map: a third of all.
        let ghosts = (0..50).map(|i| Object { real: 0.4, ..with_votes(10_000 + 10 * i, 10) });
        assert_eq!(changed(&some, &some.iter().cloned().chain(ghosts).collect::<Vec<_>>()), Some(false));
    }
}
