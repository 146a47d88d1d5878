//! The robust method: near perfect where the data allow it, sure of what it says, linear in the data.
//!
//! 1. [`noise`]: a pose-aware gate in sigmas instead of a radius in pixels.
//! 2. [`nominate`](mod@nominate): each ray meets few partners ([`sample`]) and nominates the point that a sample of images supports best.
//! 3. [`gather`](mod@gather): the best supported nomination is polished to a [`label`], on its voters and from its estimate,
//!    until the voters stay the same ([`quick`]); its voters leave; and so on. Rays left over get further rounds among
//!    themselves.
//! 4. [`associate`](mod@associate): all labels compete for all detections, the pose errors of the images taken out
//!    ([`poses`]), neighbors first untangled ([`exchange`](mod@exchange)); then the labels of each place are estimated together
//!    ([`adjust`](mod@adjust)), and those that agree within their covariances and are never seen side by side become one
//!    ([`settle`]). Again and again, but only where labels changed; and neighbors hand over what the other one explains
//!    better ([`handover`]).
//! 5. [`existence`]: hits and misses among the looks that should have seen it say how probable a label is.
//! 6. [`estimate`](mod@estimate): positions and covariances, with the pose errors of images and passes ([`drift`]), and
//!    with what votes that might be a neighbor's may have done ([`contest`]).
//! 7. [`calibrate`](mod@calibrate): the noise itself is estimated from the labels' residuals.
//!
//! Large scenes go through this first with a part of their images, the [`keyframes`].

pub mod adjust;
pub mod associate;
pub mod calibrate;
pub mod contest;
mod court;
pub mod drift;
pub mod estimate;
pub mod exchange;
pub mod existence;
pub mod gather;
pub mod grant;
pub mod handover;
pub mod index;
pub mod keyframes;
pub mod label;
pub mod noise;
pub mod nominate;
pub mod pairs;
pub mod poses;
pub mod quick;
pub mod rivals;
pub mod sample;
pub mod scene;
pub mod settle;
mod spd;

use rayon::prelude::*;

use crate::hypothesis::Viability;
use crate::progress::{Halt, Progress};

use adjust::adjust;
use calibrate::Known;
use court::{Court, Judgement, judge};
use estimate::Care;
use existence::Rates;
use gather::gather;
use keyframes::Keyframes;
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
    /// Parts that are left out, to see what they are worth.
    pub without: Without,
}

/// Parts of the method that can be left out.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Without {
    /// Nominations get the voters of the point where they were made.
    pub polish: bool,
    /// Labels of one object stay several.
    pub merge: bool,
}

/// Rays of the places that the noise is estimated from, about.
const CALIBRATION_RAYS: usize = 20_000;
/// How much wider the gate is while the noise is estimated: what a gate cuts off is missing in the estimate.
const CALIBRATION_GATE: f64 = 1.4;
/// Times that the noise is estimated anew, from labels found with the last estimate.
const CALIBRATION_ROUNDS: usize = 3;

/// How labels are found among the rays of a scene.
struct Schedule {
    /// Times that the rays of no label are gathered, at most: what is left over gets less and less.
    sessions: usize,
    /// Times that labels compete before any is doubted.
    rounds: usize,
    /// Times that neighbors hand over votes before any is doubted, and after, at most.
    handovers: usize,
}

/// For all images of a scene.
const WHOLE: Schedule = Schedule { sessions: 3, rounds: 4, handovers: 3 };
/// For the keyframes of a large one.
const KEYFRAMES: Schedule = Schedule { sessions: 1, handovers: 1, ..WHOLE };
/// For all its images, when labels competed in the keyframes.
const REFINING: Schedule = Schedule { sessions: 1, rounds: 2, handovers: 0 };

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

/// What became of everything that was proposed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Tally {
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
}

/// The labels of a scene, and what became of the rest.
#[derive(Debug, Clone)]
pub struct Findings {
    /// Labels, ordered by their lowest voter.
    pub findings: Vec<Finding>,
    /// How it came to them.
    pub tally: Tally,
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
    for round in 1..=CALIBRATION_ROUNDS {
        let spreads = spreads_of(scene, &noise);
        let (mut labels, _) = gather(scene, &noise, &spreads, &settings, &rays, progress)?;
        if round == CALIBRATION_ROUNDS {
            let mut court = Court::new(scene, &noise, &spreads, &settings, rays.iter().copied());
            for _ in 0..WHOLE.rounds {
                labels = court.settle(labels, true, &mut Tally::default(), progress)?;
            }
        }
        noise = calibrate::calibrate(scene, &noise, &labels, known);
    }
    Ok(noise)
}

/// Find the labels of a scene with a known noise.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn find(scene: &Scene, noise: &Noise, settings: &Settings, progress: &Progress) -> Result<Findings, Halt> {
    let mut tally = Tally::default();
    let keyframes = Keyframes::of(scene);
    let begun = match &keyframes {
        Some(keyframes) => found_in(keyframes, noise, settings, &mut tally, progress)?,
        None => Vec::new(),
    };
    let schedule = if keyframes.is_some() { REFINING } else { WHOLE };
    let spreads = spreads_of(scene, noise);
    let mut court = Court::new(scene, noise, &spreads, settings, 0..scene.rays.rays.len() as u32);
    let labels = court.hold(begun, &schedule, &mut tally, progress)?;
    let labels = adjust(scene, noise, settings.gate_sigmas, settings.min_votes as usize, &labels, Care::Exact);
    let before = labels.len();
    let labels = settle::outclass(scene, noise, labels);
    tally.outvoted += (before - labels.len()) as u64;
    let Judgement { of_labels, rates, strays_per_image } =
        judge(scene, &spreads, &court.sectors(&labels), &labels, settings, tally.doubted);
    let variance_factor = calibrate::variance_factor(scene, noise, &labels, labels.len().max(1));
    let before = labels.len();
    let judged = labels.into_iter().zip(of_labels).filter(|(_, (existence, _))| *existence >= settings.min_existence);
    let findings: Vec<Finding> = judged
        .map(|(mut label, (existence, expected))| {
            label.estimate.covariance *= variance_factor;
            Finding { label, existence, expected }
        })
        .collect();
    tally.doubted += (before - findings.len()) as u64;
    Ok(Findings { findings, tally, rates, strays_per_image, variance_factor })
}

/// The labels that the keyframes of a scene show.
fn found_in(
    keyframes: &Keyframes,
    noise: &Noise,
    settings: &Settings,
    tally: &mut Tally,
    progress: &Progress,
) -> Result<Vec<Label>, Halt> {
    let scene = &keyframes.scene;
    let spreads = spreads_of(scene, noise);
    let mut court = Court::new(scene, noise, &spreads, settings, 0..scene.rays.rays.len() as u32);
    let labels = court.hold(Vec::new(), &KEYFRAMES, tally, progress)?;
    Ok(labels.into_iter().map(|label| keyframes.in_whole(label)).collect())
}

/// The spread of every ray.
#[must_use]
pub fn spreads_of(scene: &Scene, noise: &Noise) -> Vec<Spread> {
    (0..scene.rays.rays.len() as u32).into_par_iter().map(|ray| noise.total(scene, ray)).collect()
}
