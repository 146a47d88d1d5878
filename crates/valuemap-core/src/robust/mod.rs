//! The robust method: near perfect where the data allow it, sure of what it says, linear in the data.
//!
//! 1. [`noise`]: a pose-aware gate in sigmas instead of a radius in pixels.
//! 2. [`nominate`](mod@nominate): each ray meets few partners ([`sample`]) and nominates the point that a sample of images supports best.
//! 3. [`gather`](mod@gather): the best supported nomination is polished to a [`label`], on its voters and from its estimate,
//!    until the voters stay the same ([`quick`]); its voters leave; and so on. Rays left over get further rounds among
//!    themselves.
//! 4. [`settle`]: all labels compete for all detections; labels that agree within their covariances and are never
//!    seen side by side become one.
//! 5. [`existence`]: hits and misses among the looks that should have seen it say how probable a label is.
//! 6. [`estimate`](mod@estimate): position and covariance, with pose errors that a pass shares.
//! 7. [`calibrate`](mod@calibrate): the noise itself is estimated from the labels' residuals.

pub mod calibrate;
pub mod estimate;
pub mod existence;
pub mod gather;
pub mod index;
pub mod label;
pub mod noise;
pub mod nominate;
pub mod quick;
pub mod sample;
pub mod scene;
pub mod settle;

use rayon::prelude::*;

use crate::hypothesis::Viability;
use crate::progress::{Halt, Progress};

use calibrate::Known;
use existence::{Lookout, Looks, Rates};
use gather::{VOTE_RANGE, gather};
use index::RayIndex;
use label::Label;
use noise::{Noise, Spread};
use scene::Scene;

/// Settings of the robust method.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// Which pairs propose points; the error in pixels is not used.
    pub viability: Viability,
    /// The gate, in sigmas.
    pub gate_sigmas: f64,
    /// Labels with fewer voters are dropped.
    pub min_votes: u32,
    /// Labels that exist with a smaller probability are dropped.
    pub min_existence: f64,
}

/// Rays of the places that the noise is estimated from, about.
const CALIBRATION_RAYS: usize = 20_000;
/// How much wider the gate is while the noise is estimated: what a gate cuts off is missing in the estimate.
const CALIBRATION_GATE: f64 = 1.4;
/// Times that the noise is estimated anew, from labels found with the last estimate.
const CALIBRATION_ROUNDS: usize = 3;

/// Labels are dropped below these multiples of the probability that is asked for, one after the other.
const DOUBTS: [f64; 4] = [1e-5, 1e-2, 0.3, 1.0];

/// Rounds of dropping and giving back at each of them, at most.
const MAX_DOUBT_ROUNDS: usize = 6;

/// A label with what speaks for it.
#[derive(Debug, Clone)]
pub struct Finding {
    /// Position, covariance, class and voters.
    pub label: Label,
    /// Probability that it exists.
    pub existence: f64,
    /// Images that should have seen it.
    pub expected: u32,
}

/// The labels of a scene, and what became of the rest.
#[derive(Debug, Clone)]
pub struct Findings {
    /// Labels, ordered by their lowest voter.
    pub findings: Vec<Finding>,
    /// Points nominated by rays.
    pub nominations: u64,
    /// Nominations that were polished to labels.
    pub accepted: u64,
    /// Labels that became part of another one.
    pub fused: u64,
    /// Labels that lost too many votes to others.
    pub outvoted: u64,
    /// Labels that probably do not exist.
    pub doubted: u64,
    /// What was learnt about detection rates.
    pub rates: Rates,
    /// Detections an image that no label has.
    pub strays_per_image: f64,
    /// What the covariances were multiplied by, so that the passes agree.
    pub variance_factor: f64,
}

/// Estimate the noise from the data, starting from a guess: labels of a sample of places with the noise as it is thought
/// to be, then the noise that makes their residuals most likely, and again. `known` parts stay as they are.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn self_calibrate(
    scene: &Scene,
    guess: &Noise,
    known: Known,
    settings: &Settings,
    progress: &Progress,
) -> Result<Noise, Halt> {
    let rays = sample::places(scene, CALIBRATION_RAYS, settings.viability.max_range_m);
    let settings = Settings { gate_sigmas: settings.gate_sigmas * CALIBRATION_GATE, ..*settings };
    let mut noise = *guess;
    for _ in 0..CALIBRATION_ROUNDS {
        let (labels, _) = gather(scene, &noise, &settings, &rays, progress)?;
        noise = calibrate::calibrate(scene, &noise, &labels, known);
    }
    Ok(noise)
}

/// Find the labels of a scene with a known noise.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn find(scene: &Scene, noise: &Noise, settings: &Settings, progress: &Progress) -> Result<Findings, Halt> {
    let all: Vec<u32> = (0..scene.rays.rays.len() as u32).collect();
    let (mut labels, [nominations, accepted]) = gather(scene, noise, settings, &all, progress)?;
    let spreads = spreads_of(scene, noise);
    let range_m = settings.viability.max_range_m * VOTE_RANGE;
    let index = RayIndex::new(scene, &spreads, settings.gate_sigmas, all.into_iter());
    let lookout = Lookout::new(scene);
    let min_votes = settings.min_votes as usize;
    let (mut fused, mut outvoted, mut doubted) = (0, 0, 0);
    let mut compete = |labels: Vec<Label>, may_split: bool| {
        let before = labels.len();
        let labels = settle::reassign(scene, noise, &index, &labels, range_m, min_votes);
        let left = labels.len();
        let labels =
            if may_split { settle::split(scene, noise, settings.gate_sigmas, labels, min_votes) } else { labels };
        let labels = settle::fuse(scene, noise, settings.gate_sigmas, labels);
        outvoted += (before - left) as u64;
        fused += left.saturating_sub(labels.len()) as u64;
        labels
    };
    for _ in 0..3 {
        progress.check()?;
        labels = compete(labels, true);
    }
    // The least probable first: what they give back may be just what a doubtful one lacks.
    for doubt in DOUBTS.map(|doubt| doubt * settings.min_existence) {
        for _ in 0..MAX_DOUBT_ROUNDS {
            progress.check()?;
            let (judged, ..) = judge(scene, &spreads, &lookout, &labels, settings);
            let before = labels.len();
            let existing = labels.into_iter().zip(judged).filter(|(_, (existence, _))| *existence >= doubt);
            labels = existing.map(|(label, _)| label).collect();
            doubted += (before - labels.len()) as u64;
            if labels.len() == before {
                break;
            }
            labels = compete(labels, false);
        }
    }
    let (judged, rates, strays_per_image) = judge(scene, &spreads, &lookout, &labels, settings);
    let variance_factor = calibrate::variance_factor(scene, noise, &labels.iter().collect::<Vec<_>>());
    let findings = labels.into_iter().zip(judged).map(|(mut label, (existence, expected))| {
        label.estimate.covariance *= variance_factor;
        Finding { label, existence, expected }
    });
    Ok(Findings {
        findings: findings.collect(),
        nominations,
        accepted,
        fused,
        outvoted,
        doubted,
        rates,
        strays_per_image,
        variance_factor,
    })
}

/// The probability of existence of each label and the number of images that should have seen it.
fn judge(
    scene: &Scene,
    spreads: &[Spread],
    lookout: &Lookout<'_>,
    labels: &[Label],
    settings: &Settings,
) -> (Vec<(f64, u32)>, Rates, f64) {
    let seen: Vec<(Vec<Looks>, u32)> = labels.par_iter().map(|label| lookout.looks(label)).collect();
    let (looks, expected): (Vec<Vec<Looks>>, Vec<u32>) = seen.into_iter().unzip();
    let rates = Rates::learn(&looks);
    let claimed: usize = labels.iter().map(|label| label.voters.len()).sum();
    let strays = (scene.rays.rays.len() - claimed) as f64 / scene.views.len() as f64;
    let solid_angle =
        scene.frusta.iter().map(|frustum| frustum.solid_angle_sr).sum::<f64>() / scene.frusta.len() as f64;
    let strays_per_sr = strays / solid_angle;
    let chance: Vec<f64> = labels
        .iter()
        .map(|label| existence::chance_of(label, scene, spreads, settings.gate_sigmas, strays_per_sr))
        .collect();
    let existence = existence::probabilities(&looks, &rates, &chance);
    (existence.into_iter().zip(expected).collect(), rates, strays)
}

/// The spread of every ray.
#[must_use]
pub fn spreads_of(scene: &Scene, noise: &Noise) -> Vec<Spread> {
    (0..scene.rays.rays.len() as u32).map(|ray| noise.total(scene, ray)).collect()
}
