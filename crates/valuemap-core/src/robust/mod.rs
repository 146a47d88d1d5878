//! The robust method: one energy J, and a search for the map with the least.
//!
//! The folders are the steps, from what is given to what is found; each uses those before it alone:
//!
//! 1. [`scene`], [`noise`], [`model`]: what was seen, its errors, and what is known of each class.
//! 2. [`energy`]: J of an object, with its position and the looks at it.
//! 3. [`learn`](mod@learn): what a map tells about each class.
//! 4. [`search`](mod@search): moves that are committed only if J falls.
//! 5. [`initial`]: the map that the search begins with.
//! 6. [`calibrate`]: the noise and the classes, from maps of samples.
//! 7. [`finish`]: from objects to labels.
//!
//! Lengths, named `_m`, are in the scene's own unit: a metre if its largest range is 60 of them, as in streets.
//!
//! [`calibrate::self_calibrate`] and [`find`] are the method: what is estimated once, and then the map.

pub mod calibrate;
pub mod energy;
pub mod finish;
pub mod initial;
pub mod learn;
pub mod model;
pub mod noise;
pub mod parts;
pub mod scene;
pub mod search;
pub mod settings;

use crate::progress::{Halt, Progress};
use calibrate::Calibration;
use energy::looks::Lookout;
use finish::Finding;
use model::{Model, Rates};
use scene::Scene;
use search::{Depth, Tally, few, search};
use settings::Settings;

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
    let mut model = Model::new(scene, &calibration.noise, settings);
    model.know(&calibration.classes, calibration.pooled, &calibration.confusions);
    let (begun, first) = initial::labels(&model, !calibration.is_deep, progress)?;
    progress.advance()?;
    let depth = if calibration.is_deep { Depth::Deep } else { Depth::Once };
    let (objects, searched) = search(&mut model, &rays, begun, depth, false, progress)?;
    let tally = Tally {
        hypotheses: first.nominations + searched.hypotheses,
        births: first.accepted + searched.births,
        deaths: first.pruned + first.outvoted + searched.deaths,
    };
    let lookout = Lookout::new(scene, settings.viability.max_range_m);
    let of_covariances = &calibration.noise_of_covariances;
    let (objects, estimates) = finish::positions::apart(&model, of_covariances, &lookout, objects, progress)?;
    let few = if settings.least_votes < settings.min_votes {
        few::objects_of_few(&model, &lookout, &rays, &objects, settings.least_votes, progress)?
    } else {
        Vec::new()
    };
    let claimed: usize = objects.iter().map(|object| object.votes.len()).sum();
    let energy = objects.iter().map(|object| object.energy).sum();
    let (findings, variance_factor) = finish::labels(&model, of_covariances, &lookout, (objects, estimates), few);
    Ok(Findings {
        findings,
        tally,
        rates: model.classes.first().map_or(Rates::GUESS, |class| class.rates),
        clutter_per_image: (rays.len() - claimed) as f64 / scene.views.len().max(1) as f64,
        energy,
        variance_factor,
    })
}
