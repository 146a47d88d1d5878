//! What is estimated once of a scene, or of a sample of it: the noise, and what each class is like.
//!
//! [`likeliest`] seeks the noise from several starts, by maps of a sample of places and their [`residuals`]. [`split`](mod@split) divides it between poses and
//! detections, and [`shared`] tells what passes disagree about. The classes are learned from a map of wider places. [`memory`] tells how far successive
//! looks err alike, and [`depth`] whether all moves of the search pay.

pub mod depth;
pub mod likeliest;
pub mod memory;
pub mod residuals;
pub mod shared;
pub mod split;

use std::sync::Arc;

use crate::progress::{Halt, Progress};
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::{Object, Placed, placed};
use crate::robust::initial;
use crate::robust::learn::confusion::confusions;
use crate::robust::learn::counts::learn_counts;
use crate::robust::learn::existence::learn_existence;
use crate::robust::learn::learn;
use crate::robust::model::confusions::Confusions;
use crate::robust::model::{ClassModel, Model, Rates};
use crate::robust::noise::index::RayIndex;
use crate::robust::noise::{Known, Noise};
use crate::robust::parts::Part;
use crate::robust::scene::{Scene, sample};
use crate::robust::search::{Depth, few, search};
use crate::robust::settings::Settings;
use depth::all_moves_pay;
use likeliest::{few_places, likeliest_noise, likelihood, noise_of_more};
use shared::with_drift_at_least;

/// Rays of the places that the noise is estimated from, about: from each start, and from the best in the end. From the starts there are up to fifteen steps and
/// in the end two, so that those have fewer rays.
const CALIBRATION_RAYS: (usize, usize) = (4_000, 10_000);
/// Rays that classes are learned from, about: some hundred objects of some hundred votes each. Of fifty, a few that are hardly seen tell whether the
/// others are seen alike.
const CLASS_RAYS: usize = 30_000;
/// Places that classes are learned from are so many ranges wide: most objects in them are seen by no other images.
const WIDE: f64 = 3.0;
/// One parameter more lowers minus twice the logarithm of the likelihood by no more than this by chance (Akaike).
const AKAIKE: f64 = 2.0;
/// Scenes with more rays than this are searched less deeply, if that changes little. It bounds the work: all moves take some ten times as long.
const MOST_RAYS: usize = 100_000;

/// Times that the range is halved. What rays of a row that is evenly spaced meet at by chance is three times as far away as what they are of, or more.
const HALVINGS: usize = 3;
/// The share of looks in vain that is left at most where rays meet at what they are of. What is met by those of every second image alone is detected half as often
/// as that: of things that are seen in two thirds of the looks, twice as many looks are in vain.
const MISSED_OF_NEARER: f64 = 0.5;

/// Steps of [`self_calibrate`] at most, as progress counts them, but for the search that tells whether all moves pay: the noise, and the classes, once more
/// where they are taken for each other; and all that once more with a nearer range, after a few steps with each that is tried.
pub const CALIBRATION_STEPS: usize = 2 * (likeliest::NOISE_STEPS + 2) + HALVINGS * (likeliest::MORE_ROUNDS + 2);

/// What is estimated once of a scene, or of a sample of it, before any part of it is mapped.
#[derive(Debug, Clone)]
pub struct Calibration {
    /// Errors of poses and detections.
    pub noise: Noise,
    /// The same where successive looks may be off alike, and drives by more than they tell: what covariances are estimated with.
    pub noise_of_covariances: Noise,
    /// What is learned of each class; nothing of those that are nowhere in the sample.
    pub classes: Vec<Option<ClassModel>>,
    /// What is learned of all classes together: what others are like.
    pub pooled: ClassModel,
    /// Which classes are taken for which.
    pub confusions: Confusions,
    /// Whether all moves pay, from all images.
    pub is_deep: bool,
}

/// Estimate the noise from the data, starting from a guess: labels of a sample of places with the noise as it is thought
/// to be, then the noise that makes their residuals most likely, and again. `known` parts, and middles that sides show, stay as they are; what was `sought` before is not
/// sought from all starts again, when [poses were compared](likeliest::misfits) or without the middles. Then learn the classes, from a map of wider places, which is returned beside.
/// Where objects are detected in fewer looks than is usual, half the range is tried as well, and so on: if half as many looks are in vain there, and that is likelier, it stays.
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
    sought: Option<Noise>,
    progress: &Progress,
) -> Result<(Calibration, Vec<Placed>), Halt> {
    let guess = &Noise { side_m: if settings.has(Part::Sides) { guess.side_m } else { 0.0 }, ..*guess };
    let is_known = known.detection && known.position && known.rotation;
    let wide = sample::places(scene, CLASS_RAYS, WIDE * settings.viability.max_range_m);
    let begin = |settings: Settings, sought: Option<Noise>| -> Result<Begun, Halt> {
        let noise = if is_known { *guess } else { noise(scene, guess, known, &settings, sought, progress)? };
        Begun::new(scene, noise, settings, &wide, progress)
    };
    let begun = begin(*settings, sought)?;
    let Begun { noise, settings: of_range, classes, pooled, confusions, objects, .. } = nearest(begun, begin)?;
    let mut model = Model::new(scene, &noise, &of_range);
    model.know(&classes, pooled, &confusions);
    let noise = if settings.has(Part::NoiseSplit) { split::split(&model, known, &objects) } else { noise };
    let noise = if settings.has(Part::SharedNoise) || is_known { noise } else { noise.all_own() };
    let map = placed(&objects);
    let noise_of_covariances = if settings.has(Part::SharedNoise) {
        noise_of_covariances(scene, &noise, guess, known, settings, &map)
    } else {
        noise
    };
    let is_small = !is_part && scene.usable_rays().len() <= MOST_RAYS;
    let is_deep = is_small || all_moves_pay(&mut model, &objects, progress)?;
    let classes = model.classes.iter().copied().map(Some).collect();
    let calibration = Calibration {
        noise,
        noise_of_covariances,
        classes,
        pooled: model.pooled,
        confusions: model.confusions,
        is_deep,
    };
    Ok((calibration, map))
}

/// What a calibration begins with: the noise that makes the rays likeliest with a range, and a map from which classes are learned.
struct Begun {
    noise: Noise,
    settings: Settings,
    classes: Vec<Option<ClassModel>>,
    pooled: ClassModel,
    confusions: Confusions,
    objects: Vec<Object>,
    /// Minus twice the logarithm of how likely the rays are.
    value: f64,
}

impl Begun {
    fn new(scene: &Scene, noise: Noise, settings: Settings, rays: &[u32], progress: &Progress) -> Result<Self, Halt> {
        let mut model = Model::new(scene, &noise, &settings);
        let objects = learn_from(&mut model, rays, progress)?;
        let value = likelihood(&model, &objects, rays);
        let classes = model.classes.into_iter().map(Some).collect();
        let (pooled, confusions) = (model.pooled, model.confusions);
        Ok(Self { noise, settings, classes, pooled, confusions, objects, value })
    }

    /// Whether objects are detected in fewer of the looks at them than is usual. So is what is none: where a row is evenly spaced, the rays of every second
    /// or third image meet far behind it.
    fn may_be_too_far(&self) -> bool {
        self.pooled.is_learned && self.pooled.rates.recall < Rates::GUESS.recall
    }

    /// The share of looks at objects that do not detect them.
    fn missed(&self) -> f64 {
        1.0 - self.pooled.rates.recall
    }
}

/// One beginning, or the likeliest of those with half its range, a quarter, and so on, in which far fewer looks are in vain, where in that one more are than
/// is usual. Which range that is, is told with the noise of that one, and only then another is sought.
fn nearest(begun: Begun, begin: impl Fn(Settings, Option<Noise>) -> Result<Begun, Halt>) -> Result<Begun, Halt> {
    let (mut settings, noise) = (begun.settings, begun.noise);
    if !settings.has(Part::NearerRanges) || !begun.may_be_too_far() {
        return Ok(begun);
    }
    let mut likeliest: Option<Begun> = None;
    for _ in 0..HALVINGS {
        settings.viability.max_range_m *= 0.5;
        let nearer = begin(settings, Some(noise))?;
        let is_seen = nearer.missed() < MISSED_OF_NEARER * begun.missed();
        if is_seen && nearer.value < likeliest.as_ref().unwrap_or(&begun).value {
            likeliest = Some(nearer);
        }
    }
    let Some(nearer) = likeliest else { return Ok(begun) };
    let anew = begin(nearer.settings, None)?;
    Ok(if anew.value < nearer.value { anew } else { nearer })
}

/// A noise whose detections remember their errors, and whose positions drift as far as was guessed where nothing tells it.
fn noise_of_covariances(
    scene: &Scene,
    noise: &Noise,
    guess: &Noise,
    known: Known,
    settings: &Settings,
    map: &[Placed],
) -> Noise {
    let sure = residuals::sample(scene, noise, map);
    let remembered =
        settings.has(Part::Memory).then(|| memory::remembered(scene, noise, known, &sure)).flatten().unwrap_or(*noise);
    if known.position { remembered } else { with_drift_at_least(scene, &sure, &remembered, guess.position_drift_m) }
}

/// The noise that makes the rays of a sample likeliest: of a few places, and then of more of them.
fn noise(
    scene: &Scene,
    guess: &Noise,
    known: Known,
    settings: &Settings,
    sought: Option<Noise>,
    progress: &Progress,
) -> Result<Noise, Halt> {
    let few = few_places(scene, settings);
    let more = sample::places(scene, CALIBRATION_RAYS.1, settings.viability.max_range_m);
    let of_few = sought.map_or_else(|| likeliest_noise(scene, guess, known, settings, &few, progress), Ok)?;
    // What was sought without middles has taken what these are off by for other errors.
    let from = Noise { side_m: guess.side_m, ..of_few };
    if more.len() == few.len() && from == of_few {
        return Ok(of_few);
    }
    noise_of_more(scene, from, known, settings, &more, progress)
}

/// Learn the classes of a model from the map of some rays, and return that. Where classes are taken for each other, all competes once more.
fn learn_from(model: &mut Model<'_>, rays: &[u32], progress: &Progress) -> Result<Vec<Object>, Halt> {
    let begun = initial::labels_of_few(model, rays, progress)?;
    let (mut objects, _) = search(model, rays, begun, Depth::Shallow, true, progress)?;
    let lookout = Lookout::new(model.scene, model.settings.viability.max_range_m);
    learn(model, &lookout, rays, &objects);
    if model.classes.len() > 1 && model.settings.has(Part::Confusions) {
        let spreads = Arc::clone(&model.spreads);
        let index = RayIndex::new(model.scene, &spreads, model.settings.gate_sigmas, rays.iter().copied());
        model.confusions = confusions(model, &lookout, &index, &objects);
        if model.confusions.is_any() {
            (objects, _) = search(model, rays, placed(&objects), Depth::Shallow, true, progress)?;
            learn(model, &lookout, rays, &objects);
        }
    }
    let few = few::objects_of_few(model, &lookout, rays, &objects, 1, progress)?;
    let [whole, mut whole_of_few] = {
        let is_whole = lookout.whole(model, rays);
        [&objects, &few].map(|all| all.iter().filter(|object| is_whole(object)).cloned().collect::<Vec<Object>>())
    };
    learn_counts(model, &whole, &whole_of_few);
    few::add_odds(model, &mut whole_of_few);
    learn_existence(model, &whole, &whole_of_few);
    Ok(objects)
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use super::*;
    use crate::street;

    /// What a calibration begins with, by its range, m, the rate of detections and how unlikely the rays are.
    fn begun(settings: Settings, recall: f64, value: f64) -> Begun {
        let scene = street::street(2, 1.0, &[], &[[0.0; 2]]);
        let pooled = Model::new(&scene, &street::NOISE, &settings).pooled;
        let pooled = ClassModel { is_learned: true, rates: Rates { recall, ..Rates::GUESS }, ..pooled };
        let (noise, confusions) = (street::NOISE, Confusions::default());
        Begun { noise, settings, classes: Vec::new(), pooled, confusions, objects: Vec::new(), value }
    }

    /// The range that stays, as a share of the first one, and how often one was begun with.
    fn share_that_stays(first: (f64, f64), nearer: (f64, f64)) -> Result<(f64, usize), Halt> {
        let tried = RefCell::new(0);
        let begin = |settings: Settings, _| {
            *tried.borrow_mut() += 1;
            Ok(begun(settings, nearer.0, nearer.1))
        };
        let stays = nearest(begun(street::SETTINGS, first.0, first.1), begin)?;
        Ok((stays.settings.viability.max_range_m / street::VIABILITY.max_range_m, tried.into_inner()))
    }

    #[test]
    fn a_nearer_range_is_taken_where_far_fewer_looks_are_in_vain_and_the_rays_are_likelier() -> Result<(), Halt> {
        assert_eq!(share_that_stays((0.45, 100.0), (0.9, 50.0))?, (0.5, HALVINGS + 1));
        assert_eq!(share_that_stays((0.45, 100.0), (0.9, 150.0))?, (1.0, HALVINGS));
        assert_eq!(share_that_stays((0.45, 100.0), (0.6, 50.0))?, (1.0, HALVINGS));
        assert_eq!(share_that_stays((0.8, 100.0), (0.95, 50.0))?, (1.0, 0));
        Ok(())
    }
}
