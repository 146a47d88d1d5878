//! The noise that makes rays likeliest: sought from several starts, each time from the map that is found with it.

use std::f64::consts::PI;
use std::rc::Rc;

use rayon::prelude::*;

use super::calibrate::{Known, calibrate};
use super::energy::{Object, fit};
use super::model::Model;
use super::noise::Noise;
use super::scene::Scene;
use super::search::{Depth, search};
use super::{CALIBRATION_RAYS, Settings, Tally, initial, placed, sample};
use crate::progress::{Halt, Progress};

/// How much wider the gate is while the noise is estimated: what a gate cuts off is missing in the estimate.
const CALIBRATION_GATE: f64 = 1.4;
/// Times that the noise is estimated anew, from labels found with the last estimate.
const CALIBRATION_ROUNDS: usize = 3;
/// Times that it is estimated from more rays than that.
const MORE_ROUNDS: usize = 2;
/// Passes that should have seen objects and did not are expected to cost no more than this, whatever is expected of them: twice the most that
/// `-p ln p` can be.
const MOST_UNSEEN: f64 = 2.0 / std::f64::consts::E;
/// The noise is sought from starts that differ by these factors.
const STARTS: [f64; 5] = [0.15, 0.5, 1.5, 5.0, 15.0];

/// Steps of [`misfit`] at most, as progress counts them.
pub const MISFIT_STEPS: usize = STARTS.len() * CALIBRATION_ROUNDS;
/// Steps of the search for the noise at most.
pub(super) const NOISE_STEPS: usize = MISFIT_STEPS + MORE_ROUNDS;

/// The noise that makes the rays of some places likeliest, `more` and some of them, and from how many starts it was sought.
pub(super) fn likeliest_noise(
    scene: &Scene,
    guess: &Noise,
    known: Known,
    settings: &Settings,
    more: &[u32],
    progress: &Progress,
) -> Result<(Noise, usize), Halt> {
    let few = sample::places(scene, CALIBRATION_RAYS.0, settings.viability.max_range_m);
    let likeliest = Likeliest::of_starts(scene, guess, known, settings, &few, progress)?;
    let (noise, starts) = (likeliest.noise().unwrap_or(*guess), likeliest.starts);
    if more.len() == few.len() {
        return Ok((noise, starts));
    }
    Ok((of_more(noise, |noise| round(scene, noise, known, settings, more, progress))?, starts))
}

/// The noise that makes more rays likeliest, some steps on from one: the one that a map was found with, or the one that was estimated from it, if
/// the map is likelier with that. Starts are not compared so: what makes the map of a poor one likeliest is a wrong noise.
fn of_more(mut noise: Noise, step: impl Fn(&Noise) -> Result<Round, Halt>) -> Result<Noise, Halt> {
    let (mut best, mut least) = (noise, f64::INFINITY);
    for _ in 0..MORE_ROUNDS {
        let found = step(&noise)?;
        let value = found.value + found.change.min(0.0);
        if value < least {
            (best, least) = (if found.change < 0.0 { found.again } else { found.noise }, value);
        }
        noise = found.again;
    }
    Ok(best)
}

/// Minus twice the logarithm of how likely some rays are with the noise that makes them likeliest, up to a constant of these rays; of a sample of
/// places where none are given, and which. It compares poses: what is true makes the same rays likelier.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn misfit(
    scene: &Scene,
    guess: &Noise,
    known: Known,
    settings: &Settings,
    rays: Option<Vec<u32>>,
    progress: &Progress,
) -> Result<(f64, Vec<u32>), Halt> {
    let range_m = settings.viability.max_range_m;
    let mut rays = rays.unwrap_or_else(|| sample::places(scene, CALIBRATION_RAYS.0, range_m));
    rays.retain(|&ray| scene.ray(ray).is_usable());
    let likeliest = Likeliest::of_starts(scene, guess, known, settings, &rays, progress)?;
    Ok((likeliest.best.map_or(f64::INFINITY, |best| best.value), rays))
}

/// One step: how likely some rays are with a noise, and the noise that is estimated from the map that it makes.
fn round(
    scene: &Scene,
    noise: &Noise,
    known: Known,
    settings: &Settings,
    rays: &[u32],
    progress: &Progress,
) -> Result<Round, Halt> {
    let settings = Settings { gate_sigmas: settings.gate_sigmas * CALIBRATION_GATE, ..*settings };
    let mut model = Model::new(scene, noise, &settings);
    let begun = initial::labels_of_few(&model, rays, progress)?;
    let objects = search(&mut model, rays, begun, Depth::Shallow, true, &mut Tally::default(), progress)?;
    let (value, left) = (likelihood(&model, &objects, rays), Left::of(&model, &objects, rays));
    let again = calibrate(scene, noise, &placed(&objects), known);
    let change = change_of_fits(&model.with_noise(&again), &objects);
    Ok(Round { noise: *noise, value, change, again, left })
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
    /// Minus twice the logarithm of how likely the rays are with it.
    value: f64,
    /// The noise that is estimated from the map that it makes.
    again: Noise,
    /// What the value changes by with that, the map as it is.
    change: f64,
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
    best: Option<Rc<Round>>,
    /// The last step from the same start: what it leaves over is no longer that of a start.
    last: Option<Rc<Round>>,
    /// From how many starts it was sought.
    starts: usize,
}

impl Likeliest {
    /// From each start some steps: it takes one to learn what passes disagree about, and another to see what that explains. What it starts with
    /// is no estimate, and not kept, however likely it makes the rays: too small, it may have an object for every few of them. Larger starts than
    /// may be likelier are left out.
    fn of_starts(
        scene: &Scene,
        guess: &Noise,
        known: Known,
        settings: &Settings,
        rays: &[u32],
        progress: &Progress,
    ) -> Result<Self, Halt> {
        let mut likeliest = Self::default();
        for factor in STARTS {
            let start = guess.scaled(factor, known);
            if likeliest.last.as_ref().is_some_and(|last| !last.may_be_larger(scene, &start)) {
                break;
            }
            likeliest.starts += 1;
            let step = |noise: &Noise| round(scene, noise, known, settings, rays, progress);
            likeliest.steps(CALIBRATION_ROUNDS - 1, step(&start)?.again, step)?;
        }
        Ok(likeliest)
    }

    /// Some steps on from a noise that was estimated. What makes the rays likelier is kept.
    fn steps(
        &mut self,
        count: usize,
        mut noise: Noise,
        step: impl Fn(&Noise) -> Result<Round, Halt>,
    ) -> Result<(), Halt> {
        let (mut last, mut is_best) = (None, false);
        for _ in 0..count {
            let found = Rc::new(step(&noise)?);
            noise = found.again;
            if self.best.as_ref().is_none_or(|best| found.value < best.value) {
                (self.best, is_best) = (Some(Rc::clone(&found)), true);
            }
            last = Some(found);
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
/// otherwise, whose density is that of the rays of no object.
fn likelihood(model: &Model<'_>, objects: &[Object], rays: &[u32]) -> f64 {
    let scene = model.scene;
    let of_class = |class: usize| {
        let of_class = || rays.iter().filter(|&&ray| scene.rays.class[ray as usize] as usize == class);
        let here = || objects.iter().filter(|object| object.class as usize == class);
        let votes: usize = here().map(|object| object.votes.len()).sum();
        let clutter = of_class().count() - votes;
        let ln_clutter = ((clutter + 1) as f64 / model.solid_angle_sr(rays.len())).ln();
        let change = ln_clutter - model.classes[class].ln_clutter_per_sr;
        let all: f64 = of_class().map(|&ray| -2.0 * (model.ln_clutter_per_px2(ray) + change)).sum();
        all + here().map(|object| object.energy + 2.0 * change * object.votes.len() as f64).sum::<f64>()
    };
    (0..model.classes.len()).map(of_class).sum()
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::street;

    #[test]
    fn rays_that_are_none_do_not_count() -> Result<(), Halt> {
        let objects: Vec<Vector3<f64>> = (0..8).map(|i| Vector3::new(25.0 + 9.0 * f64::from(i), 5.0, 3.0)).collect();
        let mut scene = street::street(80, 1.0, &objects, &[[0.7, -0.4], [-0.9, 0.8], [0.3, -0.5]]);
        let all: Vec<u32> = (0..scene.rays.rays.len() as u32).collect();
        std::sync::Arc::make_mut(&mut scene.rays).rays[7].residual_from_world.fill(f64::NAN);
        let of = |rays: Vec<u32>| {
            misfit(&scene, &street::NOISE, Known::default(), &street::SETTINGS, Some(rays), &Progress::default())
        };
        let (value, used) = of(all)?;
        assert!(value.is_finite() && used == scene.usable_rays(), "{value}");
        assert_eq!(value.to_bits(), of(scene.usable_rays())?.0.to_bits());
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
                Ok(Round { noise: *noise, value, again: noise_of(noise.detection_px + 0.5), change, left })
            })
        };
        assert!((with(-10.0)?.detection_px - 1.0).abs() < 1e-12);
        assert!((with(10.0)?.detection_px - 0.5).abs() < 1e-12);
        Ok(())
    }
}
