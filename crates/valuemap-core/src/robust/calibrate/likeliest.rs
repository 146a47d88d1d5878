//! Search for the noise that makes the rays likeliest: from several starts, each time with a map found anew.
//!
//! A map depends on the noise and the noise on the map, so that one start may end at a poor pair. Starts are compared by J with
//! the density of clutter ([`calibrate`](super::residuals) does a step).

use std::f64::consts::PI;
use std::sync::Arc;

use rayon::prelude::*;

use super::CALIBRATION_RAYS;
use super::residuals::calibrate;
use super::shared::{as_stated, stated};
use crate::progress::{Halt, Progress};
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::{Object, Placed, fit, placed};
use crate::robust::initial;
use crate::robust::model::Model;
use crate::robust::noise::{Known, Noise};
use crate::robust::scene::{Scene, sample};
use crate::robust::search::{Depth, born_of_rest, search};
use crate::robust::settings::Settings;

/// How much wider the gate is while the noise is estimated: what a gate cuts off is missing in the estimate. It cuts off no more of errors that are 1.4 times
/// as large as thought than the gate does of those that are as thought.
const CALIBRATION_GATE: f64 = 1.4;
/// Times that the noise is estimated anew, from labels found with the last estimate. What the first begins with is no estimate; it takes one to learn what
/// passes disagree about, and another to see what that explains.
const CALIBRATION_ROUNDS: usize = 3;
/// Times that it is estimated from more rays than that. One tries what few places told, and the other what is estimated from that.
pub(crate) const MORE_ROUNDS: usize = 2;
/// Passes that should have seen objects and did not are expected to cost no more than this, whatever is expected of them: twice the most that
/// `-p ln p` can be.
const MOST_UNSEEN: f64 = 2.0 / std::f64::consts::E;
/// The noise is sought from starts that differ by these factors. What lies between them is within a factor of two of one. Without the smallest, maps of real
/// data are worse, and a start of a third of it is never likeliest (`docs/notes/method.md`).
const STARTS: [f64; 5] = [0.15, 0.5, 1.5, 5.0, 15.0];

/// Steps from all starts at most, as progress counts them.
const START_STEPS: usize = STARTS.len() * CALIBRATION_ROUNDS;
/// Steps of [`misfits`] at most: in each scene those from all starts, and from the map of the other.
pub const MISFIT_STEPS: usize = 2 * (START_STEPS + 1);
/// Steps of the search for the noise at most.
pub(crate) const NOISE_STEPS: usize = START_STEPS + MORE_ROUNDS;

/// Some places of a scene, whose rays tell the noise.
pub(crate) fn few_places(scene: &Scene, settings: &Settings) -> Vec<u32> {
    sample::places(scene, CALIBRATION_RAYS.0, settings.viability.max_range_m)
}

/// The noise that makes the rays of some places likeliest, sought from all starts.
pub(crate) fn likeliest_noise(
    scene: &Scene,
    guess: &Noise,
    known: Known,
    settings: &Settings,
    few: &[u32],
    progress: &Progress,
) -> Result<Noise, Halt> {
    let sample = Sample { scene, rays: few, known, settings: wider(settings), progress };
    Ok(Likeliest::of_starts(&sample, guess)?.noise().unwrap_or_else(|| as_stated(guess, stated(scene))))
}

/// The noise that makes the rays of more places likeliest, some steps on from one.
pub(crate) fn noise_of_more(
    scene: &Scene,
    from: Noise,
    known: Known,
    settings: &Settings,
    more: &[u32],
    progress: &Progress,
) -> Result<Noise, Halt> {
    let sample = Sample { scene, rays: more, known, settings: wider(settings), progress };
    of_more(from, |noise| sample.round(noise, true))
}

/// The noise that makes more rays likeliest, some steps on from one: the one that a map was found with, or the one that was estimated from it, if
/// the map is likelier with that. Starts are not compared so: what makes the map of a poor one likeliest is a wrong noise.
fn of_more(mut noise: Noise, step: impl Fn(&Noise) -> Result<Round, Halt>) -> Result<Noise, Halt> {
    let (mut best, mut least) = (noise, f64::INFINITY);
    for _ in 0..MORE_ROUNDS {
        let found = step(&noise)?;
        let (again, change) = found.again.unwrap_or((noise, 0.0));
        let value = found.value + change.min(0.0);
        if value < least {
            (best, least) = (if change < 0.0 { again } else { noise }, value);
        }
        if again == noise {
            break;
        }
        noise = again;
    }
    Ok(best)
}

/// How badly the same rays fit in two scenes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Misfits {
    /// Minus twice the logarithm of how likely they are in each, up to a constant of theirs.
    pub values: [f64; 2],
    /// How many they are.
    pub rays: usize,
    /// The noise of the first scene that [`self_calibrate`](super::self_calibrate) would seek from all starts again; nothing if it has other rays to
    /// seek it from.
    pub of_first: Option<Noise>,
}

/// How likely the same rays, of a sample of places, are in two scenes, each with the noise that makes them likeliest there. It compares poses: what is
/// true makes the same rays likelier. `second_of_first` has the number in the second scene of each ray of the first.
///
/// A search may end above the least value, and in one scene farther above it than in the other. So each scene is offered the map of the other as
/// well, with the noise that makes it likeliest there, and the objects that the other makes of rays which its own map leaves over.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn misfits(
    scenes: [&Scene; 2],
    second_of_first: &[u32],
    guess: &Noise,
    known: Known,
    settings: &Settings,
    progress: &Progress,
) -> Result<Misfits, Halt> {
    let mut first_of_second = vec![0; second_of_first.len()];
    (0..).zip(second_of_first).for_each(|(ray, &there): (u32, &u32)| first_of_second[there as usize] = ray);
    let mut first = few_places(scenes[0], settings);
    let all = first.len();
    first.retain(|&ray| scenes[0].ray(ray).is_usable() && scenes[1].ray(second_of_first[ray as usize]).is_usable());
    let second = renamed(&first, second_of_first);
    let of = |scene, rays| Sample { scene, rays, known, settings: wider(settings), progress };
    let samples = [of(scenes[0], &first), of(scenes[1], &second)];
    // Side by side: samples are so small that threads wait for each other within each of them.
    let seek = |here: usize| Likeliest::of_starts(&samples[here], guess);
    let (first_found, second_found) = rayon::join(|| seek(0), || seek(1));
    let (first_found, second_found) = (first_found?, second_found?);
    let of_first = first_found.noise().filter(|_| first.len() == all);
    let found = [first_found.best, second_found.best];
    let least = |here: usize, numbers: &[u32]| -> Result<f64, Halt> {
        let [Some(own), Some(other)] = [&found[here], &found[1 - here]] else { return Ok(f64::INFINITY) };
        let rename = |(votes, point): &Placed| (renamed(votes, numbers), *point);
        let map = other.map.iter().map(rename).collect();
        Ok(own.value.min(samples[here].least_of_offered(own, &other.noise, map)?))
    };
    let (least_first, least_second) = rayon::join(|| least(0, &first_of_second), || least(1, second_of_first));
    Ok(Misfits { values: [least_first?, least_second?], rays: first.len(), of_first })
}

/// The objects of a map, and those that another one makes of rays which it leaves over.
fn with_left(map: &[Placed], other: &[Placed]) -> Vec<Placed> {
    let mut taken: Vec<u32> = map.iter().flat_map(|(votes, _)| votes).copied().collect();
    taken.sort_unstable();
    let is_left = |ray: &u32| taken.binary_search(ray).is_err();
    let left = |(votes, point): &Placed| (votes.iter().copied().filter(is_left).collect::<Vec<u32>>(), *point);
    map.iter().cloned().chain(other.iter().map(left).filter(|(votes, _)| votes.len() > 1)).collect()
}

/// Rays by other numbers, ascending.
fn renamed(rays: &[u32], numbers: &[u32]) -> Vec<u32> {
    let mut rays: Vec<u32> = rays.iter().map(|&ray| numbers[ray as usize]).collect();
    rays.sort_unstable();
    rays
}

/// Settings with the gate that the noise is estimated with.
fn wider(settings: &Settings) -> Settings {
    Settings { gate_sigmas: settings.gate_sigmas * CALIBRATION_GATE, ..*settings }
}

/// Some rays of a scene whose noise is sought.
struct Sample<'a> {
    scene: &'a Scene,
    rays: &'a [u32],
    known: Known,
    settings: Settings,
    progress: &'a Progress,
}

impl Sample<'_> {
    /// One step: how likely the rays are with a noise, and the noise that is estimated from the map that it makes, if that is asked for.
    fn round(&self, noise: &Noise, goes_on: bool) -> Result<Round, Halt> {
        let model = Model::new(self.scene, noise, &self.settings);
        let begun = initial::labels_of_few(&model, self.rays, self.progress)?;
        self.searched(model, begun, goes_on)
    }

    /// The last step, from a map that is there.
    fn round_from(&self, noise: &Noise, begun: Vec<Placed>) -> Result<Round, Halt> {
        self.searched(Model::new(self.scene, noise, &self.settings), begun, false)
    }

    fn searched(&self, mut model: Model<'_>, begun: Vec<Placed>, goes_on: bool) -> Result<Round, Halt> {
        let noise = model.noise;
        let (mut objects, _) = search(&mut model, self.rays, begun, Depth::Shallow, true, self.progress)?;
        let again = goes_on.then(|| calibrate(self.scene, noise, &placed(&objects), self.known));
        // What is left over gives birth: an object that a map lacks would count against its noise. But it tells no noise: it may be born of nonsense.
        let lookout = Lookout::new(self.scene, self.settings.viability.max_range_m);
        objects.extend(born_of_rest(&model, &lookout, self.rays, &objects, self.progress)?.0);
        let (value, left) = (likelihood(&model, &objects, self.rays), Left::of(&model, &objects, self.rays));
        let map = placed(&objects);
        let again = again.map(|again| (again, change_of_fits(&model.with_noise(&again), &objects)));
        Ok(Round { noise: *noise, map, value, again, left })
    }

    /// How likely the rays are if what a step found is offered the map of another scene, which was found with another noise.
    fn least_of_offered(&self, own: &Round, noise: &Noise, map: Vec<Placed>) -> Result<f64, Halt> {
        let both = self.round_from(&own.noise, with_left(&own.map, &map))?;
        let other = self.round_from(&self.noise_of(noise, &map), map)?;
        Ok(both.value.min(other.value))
    }

    /// The noise that is estimated from a map whose objects are put where another noise has them.
    fn noise_of(&self, noise: &Noise, map: &[Placed]) -> Noise {
        let model = Model::new(self.scene, noise, &self.settings);
        let place = |(votes, point): &Placed| Some((votes.clone(), fit(&model, votes, *point)?.point));
        calibrate(self.scene, noise, &map.par_iter().filter_map(place).collect::<Vec<Placed>>(), self.known)
    }
}

/// What J of some objects changes by, their votes as they are, with the noise of a model.
fn change_of_fits(model: &Model<'_>, objects: &[Object]) -> f64 {
    let of_object = |object: &Object| {
        fit(model, &object.votes, object.fit.point).map_or(f64::INFINITY, |fit| fit.energy - object.fit.energy)
    };
    objects.par_iter().map(of_object).collect::<Vec<f64>>().iter().sum()
}

/// What a step of the calibration finds with a noise.
struct Round {
    noise: Noise,
    /// The objects of the map that it makes.
    map: Vec<Placed>,
    /// Minus twice the logarithm of how likely the rays are with it.
    value: f64,
    /// The noise that is estimated from the map that it makes, and what the value changes by with that, the map as it is; nothing at the last step.
    again: Option<(Noise, f64)>,
    left: Left,
}

/// What a larger noise could still explain of some rays.
struct Left {
    /// Squared residuals of the votes, in sigmas.
    chi2: f64,
    /// Votes, each with the depth of its object, m.
    votes: Vec<(u32, f64)>,
    /// The rays of no object, each with minus twice the logarithm of the density of clutter there, 1/px².
    clutter: Vec<(u32, f64)>,
    /// Passes that see objects, or should have; and minus twice the logarithm of how probable it is of those that do not.
    passes: (usize, f64),
}

impl Left {
    fn of(model: &Model<'_>, objects: &[Object], rays: &[u32]) -> Self {
        let depth_m = |ray: u32, object: &Object| model.scene.ray(ray).project(&object.fit.point).z;
        let of_object = |object: &Object| -> Vec<(u32, f64)> {
            object.votes.iter().map(|&ray| (ray, depth_m(ray, object))).collect()
        };
        let mut votes: Vec<(u32, f64)> = objects.iter().flat_map(of_object).collect();
        votes.sort_unstable_by_key(|vote| vote.0);
        let is_left = |ray: &&u32| votes.binary_search_by_key(*ray, |vote| vote.0).is_err();
        let price = |&ray: &u32| (ray, -2.0 * model.ln_clutter_per_px2(ray));
        let clutter = rays.iter().filter(is_left).map(price).collect();
        let of_passes = objects.iter().map(|object| object.seen.missed(&model.classes[object.class as usize]));
        let passes = of_passes.fold((0, 0.0), |sum, one| (sum.0 + one.0, sum.1 + 2.0 * one.1));
        Self { chi2: objects.iter().flat_map(|object| &object.fit.chi2).sum(), votes, clutter, passes }
    }
}

impl Round {
    /// The noise of the next step; nothing if there is none, or the noise stays as it is and would make the same map again.
    fn next(&self) -> Option<Noise> {
        self.again.map(|(again, _)| again).filter(|again| *again != self.noise)
    }

    /// Whether a larger noise may make the rays likelier. If it explained the votes without any residual, and the rays of no object as well,
    /// each of them would still be as improbable as a residual of 0 is: how much more so than now, grows with the noise. But passes that
    /// disagree by more than is thought do not see each other's objects, and that is no residual.
    fn may_be_larger(&self, scene: &Scene, noise: &Noise) -> bool {
        let (passes, unseen) = self.left.passes;
        if unseen > MOST_UNSEEN * passes as f64 {
            return true;
        }
        let wider = |&(ray, depth_m): &(u32, f64)| {
            let [now, then] = [&self.noise, noise].map(|noise| noise.total(scene, ray).variance(depth_m));
            2.0 * (then / now).ln()
        };
        let explained =
            |&(ray, price): &(u32, f64)| (price - 2.0 * (2.0 * PI * noise.total(scene, ray).far_px2).ln()).max(0.0);
        let gain = self.left.chi2 + self.left.clutter.iter().map(explained).sum::<f64>();
        self.left.votes.iter().map(wider).sum::<f64>() <= gain
    }
}

/// What makes the same rays likeliest so far.
#[derive(Default)]
struct Likeliest {
    best: Option<Arc<Round>>,
    /// The last step from the same start: what it leaves over is no longer that of a start.
    last: Option<Arc<Round>>,
}

impl Likeliest {
    /// From each start some steps: it takes one to learn what passes disagree about, and another to see what that explains. What it starts with
    /// is no estimate, and not kept, however likely it makes the rays: too small, it may have an object for every few of them. Larger starts than
    /// may be likelier are left out.
    fn of_starts(sample: &Sample<'_>, guess: &Noise) -> Result<Self, Halt> {
        let (mut likeliest, stated) = (Self::default(), stated(sample.scene));
        for factor in STARTS {
            let start = as_stated(&guess.scaled(factor, sample.known), stated);
            if likeliest.last.as_ref().is_some_and(|last| !last.may_be_larger(sample.scene, &start)) {
                break;
            }
            // A map of too few objects tells no noise: what it is then is where it began, and no estimate.
            if let Some(noise) = sample.round(&start, true)?.next() {
                likeliest.steps(CALIBRATION_ROUNDS - 1, noise, |noise, goes_on| sample.round(noise, goes_on))?;
            }
        }
        Ok(likeliest)
    }

    /// Some steps on from a noise that was estimated. What makes the rays likelier is kept.
    fn steps(
        &mut self,
        count: usize,
        mut noise: Noise,
        step: impl Fn(&Noise, bool) -> Result<Round, Halt>,
    ) -> Result<(), Halt> {
        let (mut last, mut is_best) = (None, false);
        for left in (0..count).rev() {
            let found = Arc::new(step(&noise, left > 0)?);
            if self.best.as_ref().is_none_or(|best| found.value < best.value) {
                (self.best, is_best) = (Some(Arc::clone(&found)), true);
            }
            last = Some(Arc::clone(&found));
            let Some(next) = found.next() else { break };
            noise = next;
        }
        if is_best {
            self.last = last;
        }
        Ok(())
    }

    fn noise(&self) -> Option<Noise> {
        self.best.as_ref().map(|best| best.noise)
    }
}

/// Minus twice the logarithm of the likelihood of some rays, clutter and votes, up to a constant: J, and the Poisson process of what is clutter
/// otherwise, whose density is that of the rays of no object, and whose scores have that of all rays once those of votes are taken out:
/// `p(score) = (share ratio + 1 - share) p_clutter(score)`.
pub(crate) fn likelihood(model: &Model<'_>, objects: &[Object], rays: &[u32]) -> f64 {
    let scene = model.scene;
    let of_class = |class: usize| {
        let is_of = |ray: u32| scene.class_of(ray) as usize == class;
        let of_class = || rays.iter().filter(|&&ray| is_of(ray));
        // An object may have votes of other classes.
        let votes = objects.iter().flat_map(|object| &object.votes).filter(|&&ray| is_of(ray)).count();
        let clutter = of_class().count() - votes;
        let ln_clutter = ((clutter + 1) as f64 / model.solid_angle_sr(rays.len())).ln();
        let change = ln_clutter - model.classes[class].ln_clutter_per_sr;
        let share = (votes as f64 / of_class().count().max(1) as f64).min(1.0);
        let ln_score = |ray: u32| -(share * model.ln_score_ratio(ray).exp() + 1.0 - share).ln();
        let all: f64 = of_class().map(|&ray| -2.0 * (model.ln_clutter_per_px2(ray) + change + ln_score(ray))).sum();
        let energy: f64 =
            objects.iter().filter(|object| object.class as usize == class).map(|object| object.energy).sum();
        all + energy + 2.0 * change * votes as f64
    };
    (0..model.classes.len()).map(of_class).sum()
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Vector3};

    use super::*;
    use crate::robust::energy::object;
    use crate::robust::learn::learn;
    use crate::robust::parts::Without;
    use crate::street;

    /// Between minus a half and a half.
    fn uniform(number: u64) -> f64 {
        sample::scramble(number) as f64 / u64::MAX as f64 - 0.5
    }

    /// Two rows of three, 0.5 m apart, as four drives see them that are off by up to half of some metres on each axis.
    fn rows(off_m: f64, seed: u64) -> Vec<Scene> {
        let in_row = |i: i32| Vector3::new(25.0 + 12.0 * f64::from(i / 3), 4.0 + 0.5 * f64::from(i % 3), 3.0);
        let objects: Vec<Vector3<f64>> = (0..6).map(in_row).collect();
        let errors: Vec<[f64; 2]> = (0..997).map(|i| [2 * i, 2 * i + 1].map(|number| 4.0 * uniform(number))).collect();
        let drive = |drive: u64| {
            let [x, y, z] = [0, 1, 2].map(|axis| off_m * uniform(seed + 3 * drive + axis));
            street::moved(street::street(20, 2.5, &objects, &errors), &Isometry3::translation(x, y, z))
        };
        (0..4).map(drive).collect()
    }

    fn whole<'a>(scene: &'a Scene, rays: &'a [u32], progress: &'a Progress) -> Sample<'a> {
        Sample { scene, rays, known: Known::default(), settings: wider(&street::SETTINGS), progress }
    }

    fn misfits_of(scenes: [&Scene; 2], second_of_first: &[u32]) -> Result<Misfits, Halt> {
        let (known, progress) = (Known::default(), Progress::default());
        misfits(scenes, second_of_first, &street::NOISE, known, &street::SETTINGS, &progress)
    }

    fn eight_in_a_street() -> Scene {
        let objects: Vec<Vector3<f64>> = (0..8).map(|i| Vector3::new(25.0 + 9.0 * f64::from(i), 5.0, 3.0)).collect();
        street::street(80, 1.0, &objects, &[[0.7, -0.4], [-0.9, 0.8], [0.3, -0.5]])
    }

    #[test]
    fn an_object_that_a_map_lacks_does_not_count_against_its_noise() -> Result<(), Halt> {
        let (scene, progress) = (eight_in_a_street(), Progress::default());
        let rays = scene.usable_rays();
        let sample = whole(&scene, &rays, &progress);
        let all = sample.round(&street::NOISE, false)?;
        let lacking = sample.round_from(&street::NOISE, all.map[1..].to_vec())?;
        assert_eq!((all.map.len(), lacking.map.len()), (8, 8));
        assert!((lacking.value - all.value).abs() < 10.0, "{} {}", lacking.value, all.value);
        Ok(())
    }

    #[test]
    fn rays_that_are_none_do_not_count() -> Result<(), Halt> {
        let mut scene = eight_in_a_street();
        std::sync::Arc::make_mut(&mut scene.rays).rays[7].residual_from_world.fill(f64::NAN);
        let same: Vec<u32> = (0..scene.rays.rays.len() as u32).collect();
        let Misfits { values: [one, other], rays, .. } = misfits_of([&scene, &scene], &same)?;
        assert!(one.is_finite() && rays == scene.usable_rays().len(), "{one} {rays}");
        assert_eq!(one.to_bits(), other.to_bits());
        Ok(())
    }

    #[test]
    fn a_scene_is_offered_the_map_of_the_other() -> Result<(), Halt> {
        // In the second scene the drives are where they say, and in the other order.
        let (first, second) = (street::joined(rows(0.8, 1400)), rows(0.0, 0));
        let second = street::joined(second.into_iter().rev().collect());
        let (rays, progress) = (first.usable_rays(), Progress::default());
        let sample = whole(&first, &rays, &progress);
        let alone = Likeliest::of_starts(&sample, &street::NOISE)?.best.map_or(f64::NAN, |best| best.value);
        let of_drive = rays.len() as u32 / 4;
        let second_of_first: Vec<u32> =
            rays.iter().map(|ray| (3 - ray / of_drive) * of_drive + ray % of_drive).collect();
        let [offered, there] = misfits_of([&first, &second], &second_of_first)?.values;
        assert!(there < offered && offered < alone - 20.0, "{there} {offered} {alone}");
        Ok(())
    }

    #[test]
    fn a_map_is_offered_what_it_leaves_over_of_the_map_of_another_scene() -> Result<(), Halt> {
        let (scene, progress) = (eight_in_a_street(), Progress::default());
        let rays = scene.usable_rays();
        let mut sample = whole(&scene, &rays, &progress);
        sample.settings.without = Without::named(&["births".to_owned()]).unwrap_or_default();
        let all = sample.round(&street::NOISE, false)?;
        let [own, other] = [0..7, 1..8].map(|some| sample.round_from(&street::NOISE, all.map[some].to_vec()));
        let (own, other) = (own?, other?);
        assert_eq!((own.map.len(), other.map.len()), (7, 7));
        let offered = sample.least_of_offered(&own, &other.noise, other.map)?;
        assert!((offered - all.value).abs() < 10.0, "{offered} {}", all.value);
        assert!(offered < own.value.min(other.value) - 100.0, "{} {}", own.value, other.value);
        Ok(())
    }

    #[test]
    fn what_no_image_of_a_sample_is_near_counts_as_well() -> Result<(), Halt> {
        let objects: Vec<Vector3<f64>> = (0..6).map(|i| Vector3::new(51.0 + f64::from(i), 4.0, 3.0)).collect();
        let errors = [[0.7, -0.4], [-0.9, 0.8], [0.3, -0.5]];
        let drives = |ahead_m: f64| {
            let drive = street::street(20, 1.0, &objects, &errors);
            street::joined(vec![drive.clone(), street::moved(drive, &Isometry3::translation(ahead_m, 0.0, 0.0))])
        };
        // From where the second drive says that it was, some objects are within the range; from where it was, none is. Objects are whole metres apart:
        // moved by whole metres, one would stand where another one does.
        let (right, wrong) = (drives(0.0), drives(4.5));
        let viability = crate::viability::Viability { max_range_m: 31.0, ..street::VIABILITY };
        let settings = Settings { viability, ..street::SETTINGS };
        let same: Vec<u32> = (0..right.rays.rays.len() as u32).collect();
        let scenes = [&right, &wrong];
        let (known, progress) = (Known::default(), Progress::default());
        let [right, wrong] = misfits(scenes, &same, &street::NOISE, known, &settings, &progress)?.values;
        assert!(right < wrong, "{right} {wrong}");
        Ok(())
    }

    #[test]
    fn scores_say_no_more_than_which_rays_are_votes() -> Result<(), Halt> {
        let mut scene = eight_in_a_street();
        let (rays, progress) = (scene.usable_rays(), Progress::default());
        let map = whole(&scene, &rays, &progress).round(&street::NOISE, false)?.map;
        // Two objects are left out: what they have is clutter, and has lower scores.
        let map = &map[..map.len() - 2];
        let votes: usize = map.iter().map(|(votes, _)| votes.len()).sum();
        let share = votes as f64 / rays.len() as f64;
        let entropy = -share * share.ln() - (1.0 - share) * (1.0 - share).ln();
        let value = |scene: &Scene| {
            let mut model = Model::new(scene, &street::NOISE, &street::SETTINGS);
            let lookout = Lookout::new(scene, street::VIABILITY.max_range_m);
            let place = |model: &Model<'_>| -> Vec<Object> {
                map.iter().filter_map(|(votes, at)| object(model, &lookout, votes.clone(), *at)).collect()
            };
            let objects = place(&model);
            learn(&mut model, &lookout, &rays, &objects);
            likelihood(&model, &place(&model), &rays)
        };
        scene.score.fill(f64::NAN);
        let without = value(&scene);
        scene.score.fill(0.3);
        map.iter().flat_map(|(votes, _)| votes).for_each(|&ray| scene.score[ray as usize] = 0.8);
        let gain = without - value(&scene);
        let most = 2.0 * rays.len() as f64 * entropy;
        assert!(gain > 0.8 * most && gain <= most, "{gain} {most}");
        Ok(())
    }

    #[test]
    fn of_more_rays_the_noise_that_makes_a_map_likeliest_is_kept_not_the_one_that_it_was_found_with() -> Result<(), Halt>
    {
        let noise_of = |detection_px: f64| Noise { detection_px, ..street::NOISE };
        let with = |change: f64| {
            of_more(noise_of(0.5), |noise| {
                let left = Left { chi2: 0.0, votes: Vec::new(), clutter: Vec::new(), passes: (0, 0.0) };
                // The first map is the likeliest.
                let value = if noise.detection_px < 1.0 { 0.0 } else { 100.0 };
                let again = Some((noise_of(noise.detection_px + 0.5), change));
                Ok(Round { noise: *noise, map: Vec::new(), value, again, left })
            })
        };
        assert!((with(-10.0)?.detection_px - 1.0).abs() < 1e-12);
        assert!((with(10.0)?.detection_px - 0.5).abs() < 1e-12);
        Ok(())
    }

    #[test]
    fn a_noise_that_stays_as_it_is_takes_no_further_step() -> Result<(), Halt> {
        let steps = |change_px: f64| {
            let taken = std::cell::Cell::new(0);
            let step = |noise: &Noise, _| {
                taken.set(taken.get() + 1);
                let left = Left { chi2: 0.0, votes: Vec::new(), clutter: Vec::new(), passes: (0, 0.0) };
                let again = Some((Noise { detection_px: noise.detection_px + change_px, ..*noise }, 0.0));
                Ok(Round { noise: *noise, map: Vec::new(), value: 0.0, again, left })
            };
            Likeliest::default().steps(3, street::NOISE, step)?;
            Ok(taken.get())
        };
        assert_eq!([steps(0.0)?, steps(0.1)?], [1, 3]);
        Ok(())
    }
}
