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
//!    ([`settle`]). Again and again, but only where labels changed.
//! 5. [`existence`]: hits and misses among the looks that should have seen it say how probable a label is.
//! 6. [`estimate`](mod@estimate): positions and covariances, with the pose errors of images and passes ([`drift`]).
//! 7. [`calibrate`](mod@calibrate): the noise itself is estimated from the labels' residuals.

pub mod adjust;
pub mod associate;
pub mod calibrate;
pub mod contest;
pub mod drift;
pub mod estimate;
pub mod exchange;
pub mod existence;
pub mod gather;
pub mod grant;
pub mod index;
pub mod keyframes;
pub mod label;
pub mod noise;
pub mod nominate;
pub mod poses;
pub mod quick;
pub mod rivals;
pub mod sample;
pub mod scene;
pub mod settle;
mod spd;

use std::sync::{Arc, OnceLock};

use nalgebra::Vector3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::hypothesis::Viability;
use crate::progress::{Halt, Progress};

use adjust::adjust;
use associate::Association;
use calibrate::Known;
use estimate::Care;
use existence::{Lookout, Looks, Rates, Sector};
use gather::{VOTE_RANGE, gather};
use index::RayIndex;
use keyframes::Keyframes;
use label::{Label, fingerprint};
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

/// Times that the rays of no label are gathered, at most.
const SESSIONS: usize = 3;
/// The same in a large scene, first in its keyframes and then in all images: what is left over gets less and less.
const SESSIONS_OF_LARGE: usize = 1;

/// Times that labels compete before any is doubted.
const SETTLING_ROUNDS: usize = 4;
/// The same for labels that competed in the keyframes.
const REFINING_ROUNDS: usize = 2;

/// Labels are dropped below these multiples of the probability that is asked for, one after the other, and then below that.
const DOUBTS: [f64; 3] = [1e-5, 1e-2, 0.3];

/// Rounds of dropping and giving back at the end, at most.
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
        let (mut labels, _) = gather(scene, &noise, &settings, &rays, progress)?;
        if round == CALIBRATION_ROUNDS {
            let spreads = spreads_of(scene, &noise);
            let mut court = Court::new(scene, &noise, &spreads, &settings, rays.iter().copied());
            for _ in 0..SETTLING_ROUNDS {
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
    let (sessions, rounds) =
        if keyframes.is_some() { (SESSIONS_OF_LARGE, REFINING_ROUNDS) } else { (SESSIONS, SETTLING_ROUNDS) };
    let spreads = spreads_of(scene, noise);
    let mut court = Court::new(scene, noise, &spreads, settings, 0..scene.rays.rays.len() as u32);
    let labels = court.hold(begun, sessions, rounds, &mut tally, progress)?;
    let labels = adjust(scene, noise, settings.gate_sigmas, settings.min_votes as usize, &labels, Care::Exact);
    let before = labels.len();
    let labels = settle::outclass(scene, noise, labels);
    tally.outvoted += (before - labels.len()) as u64;
    let Judgement { of_labels, rates, strays_per_image } =
        judge(scene, &spreads, &court.sectors(&labels), &labels, settings, tally.doubted);
    let variance_factor = calibrate::variance_factor(scene, noise, &labels);
    let findings = labels.into_iter().zip(of_labels).map(|(mut label, (existence, expected))| {
        label.estimate.covariance *= variance_factor;
        Finding { label, existence, expected }
    });
    Ok(Findings { findings: findings.collect(), tally, rates, strays_per_image, variance_factor })
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
    let labels = court.hold(Vec::new(), SESSIONS_OF_LARGE, SETTLING_ROUNDS, tally, progress)?;
    Ok(labels.into_iter().map(|label| keyframes.in_whole(label)).collect())
}

/// Where labels compete for the rays.
struct Court<'a> {
    scene: &'a Scene,
    noise: &'a Noise,
    spreads: &'a [Spread],
    settings: &'a Settings,
    association: Association<'a>,
    lookout: OnceLock<Lookout<'a>>,
    /// The sectors of the labels as they last were.
    seen_from: FxHashMap<(u64, u64), Arc<[Sector]>>,
}

impl<'a> Court<'a> {
    fn new(
        scene: &'a Scene,
        noise: &'a Noise,
        spreads: &'a [Spread],
        settings: &'a Settings,
        rays: impl Iterator<Item = u32>,
    ) -> Self {
        let index = RayIndex::new(scene, spreads, settings.gate_sigmas, rays);
        let range_m = settings.viability.max_range_m * VOTE_RANGE;
        Self {
            scene,
            noise,
            spreads,
            settings,
            association: Association::new(scene, noise, index, range_m),
            lookout: OnceLock::new(),
            seen_from: FxHashMap::default(),
        }
    }

    /// Find labels among all rays, beginning with those that were found already.
    fn hold(
        &mut self,
        begun: Vec<Label>,
        sessions: usize,
        rounds: usize,
        tally: &mut Tally,
        progress: &Progress,
    ) -> Result<Vec<Label>, Halt> {
        let mut labels = if begun.is_empty() { begun } else { self.settle(begun, false, tally, progress)? };
        // What a doubted label gives back, and what settled labels leave, may be seen more clearly now.
        for _ in 0..sessions {
            let before = labels.len();
            let new = self.left_over(&labels, tally, progress)?;
            let is_raw = labels.is_empty();
            labels = if is_raw { new } else { self.admit(labels, new, tally) };
            labels.sort_by_key(settle::first_voter);
            for _ in 0..rounds {
                labels = self.settle(labels, true, tally, progress)?;
            }
            labels = self.doubt(labels, is_raw, tally, progress)?;
            if labels.len() <= before {
                break;
            }
        }
        Ok(labels)
    }

    /// Labels of the rays that no label has; if there are others, these compete among themselves first.
    fn left_over(&self, labels: &[Label], tally: &mut Tally, progress: &Progress) -> Result<Vec<Label>, Halt> {
        let &Self { scene, noise, spreads, settings, .. } = self;
        let mut is_taken = vec![false; scene.rays.rays.len()];
        for &ray in labels.iter().flat_map(|label| &label.voters) {
            is_taken[ray as usize] = true;
        }
        let free: Vec<u32> = (0..is_taken.len() as u32).filter(|&ray| !is_taken[ray as usize]).collect();
        let (mut new, [nominations, accepted]) = gather(scene, noise, settings, &free, progress)?;
        tally.nominations += nominations;
        tally.accepted += accepted;
        if !labels.is_empty() {
            let mut annex = Court::new(scene, noise, spreads, settings, free.into_iter());
            for _ in 0..SETTLING_ROUNDS {
                new = annex.settle(new, true, tally, progress)?;
            }
            // Where others took what they might have had they were not missed.
            new.par_iter_mut().for_each(|label| {
                let taken = self.association.images_at(label, |ray| is_taken[ray as usize]);
                label.undecided.extend(taken);
                label.undecided.sort_unstable();
                label.undecided.dedup();
            });
        }
        Ok(new)
    }

    /// One round: neighbors exchange votes, all labels compete for all rays, those that are two are split and those that are
    /// one are fused.
    fn settle(
        &mut self,
        labels: Vec<Label>,
        may_split: bool,
        tally: &mut Tally,
        progress: &Progress,
    ) -> Result<Vec<Label>, Halt> {
        progress.check()?;
        let &mut Self { scene, noise, settings, .. } = self;
        let gate = settings.gate_sigmas;
        let min_votes = settings.min_votes as usize;
        let before = labels.len();
        let labels = exchange::exchange(scene, noise, gate, labels);
        let mut labels = self.association.associate(labels, progress)?;
        labels.retain(|label| label.voters.len() >= min_votes);
        let labels = adjust(scene, noise, gate, min_votes, &labels, Care::Rough);
        let left = labels.len();
        let labels = if may_split { settle::split(scene, noise, gate, labels, min_votes) } else { labels };
        let labels = if settings.without.merge { labels } else { settle::fuse(scene, noise, gate, labels) };
        tally.outvoted += (before - left) as u64;
        tally.fused += left.saturating_sub(labels.len()) as u64;
        Ok(labels)
    }

    fn sectors_of(&self, label: &Label) -> Arc<[Sector]> {
        self.lookout.get_or_init(|| Lookout::new(self.scene)).sectors(label).into()
    }

    /// The sectors that each label is seen from.
    fn sectors(&mut self, labels: &[Label]) -> Vec<Arc<[Sector]>> {
        let key_of = |label: &Label| (label.identity(), fingerprint(&label.undecided));
        let of_label =
            |label: &Label| self.seen_from.get(&key_of(label)).map_or_else(|| self.sectors_of(label), Arc::clone);
        let found: Vec<Arc<[Sector]>> = labels.par_iter().map(of_label).collect();
        self.seen_from = labels.iter().map(key_of).zip(found.iter().cloned()).collect();
        found
    }

    /// Some labels with those of others that probably exist.
    fn admit(&mut self, mut labels: Vec<Label>, new: Vec<Label>, tally: &mut Tally) -> Vec<Label> {
        let old = labels.len();
        labels.extend(new);
        let sectors = self.sectors(&labels);
        let judgement = judge(self.scene, self.spreads, &sectors, &labels, self.settings, tally.doubted);
        let before = labels.len();
        let admitted = labels.into_iter().zip(judgement.of_labels).enumerate();
        let admitted =
            admitted.filter(|(i, (_, (existence, _)))| *i < old || *existence >= self.settings.min_existence);
        let labels: Vec<Label> = admitted.map(|(_, (label, _))| label).collect();
        tally.doubted += (before - labels.len()) as u64;
        labels
    }

    /// Take votes away from labels that look as if they were not to be seen from there. Also the sectors of those left.
    fn look_around(&mut self, labels: Vec<Label>, tally: &mut Tally) -> (Vec<Label>, Vec<Arc<[Sector]>>) {
        let before = labels.len();
        let sectors = self.sectors(&labels);
        let of_label = |(label, sectors): (Label, Arc<[Sector]>)| {
            let stray: Vec<Vector3<f64>> =
                sectors.iter().filter(|sector| sector.is_stray()).map(|sector| sector.direction).collect();
            if stray.is_empty() {
                return Some((label, sectors));
            }
            let unseen_from = [label.unseen_from.as_slice(), &stray].concat();
            let label = Label { unseen_from: unseen_from.clone(), ..label };
            let seen = label.voters.iter().copied().filter(|&ray| label.faces(self.scene, ray)).collect();
            let start = label.estimate.point;
            let found = label::from_voters(self.scene, self.noise, self.settings.gate_sigmas, seen, start)?;
            let enough = found.voters.len() >= self.settings.min_votes as usize;
            let left = enough.then_some(Label { undecided: label.undecided, unseen_from, ..found })?;
            let sectors = self.sectors_of(&left);
            Some((left, sectors))
        };
        let (labels, sectors): (Vec<Label>, Vec<_>) =
            labels.into_par_iter().zip(sectors).filter_map(of_label).collect::<Vec<_>>().into_iter().unzip();
        tally.doubted += (before - labels.len()) as u64;
        (labels, sectors)
    }

    /// Drop the labels that probably do not exist, the least probable first: what they give back may be just what a doubtful
    /// one lacks.
    fn doubt(&mut self, mut labels: Vec<Label>, is_raw: bool, tally: &mut Tally, progress: &Progress) -> Result<Vec<Label>, Halt> {
        if is_raw || std::env::var("GR").is_ok() {
            for doubt in DOUBTS {
                labels = self.drop_below(doubt, labels, tally, progress)?;
            }
        }
        for _ in 0..MAX_DOUBT_ROUNDS {
            let dropped = tally.doubted;
            labels = self.drop_below(1.0, labels, tally, progress)?;
            if tally.doubted == dropped {
                break;
            }
        }
        Ok(labels)
    }

    /// Drop the labels that are less probable than a multiple of what is asked for, and let the others compete for their votes.
    fn drop_below(
        &mut self,
        doubt: f64,
        labels: Vec<Label>,
        tally: &mut Tally,
        progress: &Progress,
    ) -> Result<Vec<Label>, Halt> {
        let (labels, sectors) = self.look_around(labels, tally);
        let judgement = judge(self.scene, self.spreads, &sectors, &labels, self.settings, tally.doubted);
        let before = labels.len();
        let judged = labels.into_iter().zip(judgement.of_labels);
        let existing = judged.filter(|(_, (existence, _))| *existence >= doubt * self.settings.min_existence);
        let labels: Vec<Label> = existing.map(|(label, _)| label).collect();
        tally.doubted += (before - labels.len()) as u64;
        if labels.len() == before { Ok(labels) } else { self.settle(labels, false, tally, progress) }
    }
}

/// How probable it is that labels exist, and what that rests on.
struct Judgement {
    /// Probability of existence of each label, and the images that should have seen it.
    of_labels: Vec<(f64, u32)>,
    rates: Rates,
    strays_per_image: f64,
}

fn judge(
    scene: &Scene,
    spreads: &[Spread],
    sectors: &[Arc<[Sector]>],
    labels: &[Label],
    settings: &Settings,
    doubted: u64,
) -> Judgement {
    let looks: Vec<Vec<Looks>> = sectors.par_iter().map(|sectors| existence::looks_of(sectors.iter())).collect();
    let expected = sectors.iter().map(|sectors| sectors.iter().map(|sector| sector.expected).sum());
    let rates = Rates::learn(&looks);
    let claimed: usize = labels.iter().map(|label| label.voters.len()).sum();
    let strays_per_image = (scene.rays.rays.len() - claimed) as f64 / scene.views.len() as f64;
    let solid_angle =
        scene.frusta.iter().map(|frustum| frustum.solid_angle_sr).sum::<f64>() / scene.frusta.len() as f64;
    let strays_per_sr = strays_per_image / solid_angle;
    let chance: Vec<f64> = labels
        .par_iter()
        .map(|label| existence::chance_of(label, scene, spreads, settings.gate_sigmas, strays_per_sr))
        .collect();
    let existence = existence::probabilities(&looks, &rates, &chance, doubted);
    Judgement { of_labels: existence.into_iter().zip(expected).collect(), rates, strays_per_image }
}

/// The spread of every ray.
#[must_use]
pub fn spreads_of(scene: &Scene, noise: &Noise) -> Vec<Spread> {
    (0..scene.rays.rays.len() as u32).into_par_iter().map(|ray| noise.total(scene, ray)).collect()
}
