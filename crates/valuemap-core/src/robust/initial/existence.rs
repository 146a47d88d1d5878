//! First test of existence: hits and misses among the looks that should have seen a label.
//!
//! A look is a viewpoint with at least one image that has the label in its picture, from a direction and distance from which it
//! was seen. A real object is detected in a share of the looks that varies from pass to pass (beta-binomial). Where there is
//! nothing, a look has a detection in the gate by chance alone. Where a label is looked at many times from a direction and hit a
//! few times, these votes are of other things. Equation (5) of `docs/method.md` replaces this in the search.

use std::f64::consts::PI;

use nalgebra::Vector3;
use rayon::prelude::*;

use super::label::{Label, direction_to, sector_middles};
use crate::robust::energy::looks::{Lookout, SECTOR_COSINE};
use crate::robust::learn::rates::{CORRELATION, LEAST_LOOKS, LEAST_LOOKS_OF_PASS, recall};
use crate::robust::model;
use crate::robust::noise::Spread;
use crate::robust::scene::Scene;

/// So many times more probable must be that the hits in a sector are not the label's, before its votes are taken away (logarithm). Where both are as probable
/// before, one in 150 is wrong.
const CLUTTER_LOG_ODDS: f64 = 5.0;
/// More hits in a sector than this are no accident. Three rays tell where an object is by themselves (`LEAST_VOTES`).
const MOST_HITS_OF_CLUTTER: u32 = 2;

/// Nearer than this nothing is expected to be seen, m. An error of a decimetre in the camera's position moves what is nearer by more than a degree.
const NEAREST_M: f64 = 4.0;

/// Share of looks in which detections of other objects happen to lie in the gate of nothing. Larger: objects that are hardly seen are taken for nothing;
/// smaller: nothing beside objects is taken for one.
const COINCIDENCE: f64 = 0.05;
/// How little that share varies between passes, see [`Rates::concentration`]. Its standard deviation is about as large as the share then.
const COINCIDENCE_CONCENTRATION: f64 = 15.0;
/// Odds that a point which gathered enough votes to be judged is nothing, where hardly any was found to be: it was chosen as
/// the best of many, so plain odds would flatter it. With harder odds for all, objects that one pass sees are lost.
const ODDS_AGAINST: f64 = 10.0;
/// How much they grow with the number of those, for each label, that were found to be nothing: what is left is the best of
/// so many more.
const ODDS_PER_PRUNED: f64 = 4.0;

/// Directions that a label is looked at from: around those of some of its votes.
#[derive(Debug, Clone)]
pub struct Sector {
    /// The middle, from the label.
    pub direction: Vector3<f64>,
    /// Its looks, by pass, ascending.
    pub looks: Vec<Looks>,
}

/// Looks of one pass at a label.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Looks {
    /// The pass.
    pub pass: u32,
    /// Viewpoints that should have seen it.
    pub expected: u32,
    /// Viewpoints that did.
    pub hits: u32,
}

/// How often objects and nothing are detected, learnt from the labels themselves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rates {
    /// Mean share of looks with a detection, of real objects.
    pub recall: f64,
    /// How much that share varies between passes: as if this many looks had been seen before (beta prior).
    pub concentration: f64,
}

/// The sectors that a label was seen from at least once.
#[must_use]
pub fn sectors(lookout: &Lookout, scene: &Scene, label: &Label) -> Vec<Sector> {
    let point = label.estimate.point;
    let mut voters = label.voters.clone();
    voters.sort_unstable();
    let (middles, farthest) = middles_of(scene, &point, &voters);
    let range = farthest.iter().copied().fold(0.0, f64::max);
    let voted = label.images(scene);
    let mut looks: Vec<Vec<(u32, u32, bool)>> = vec![Vec::new(); middles.len()];
    for image in lookout.around(&point, range) {
        let view = &scene.views[image as usize];
        let away = view.center - point;
        let distance = away.norm();
        if distance > range * (1.0 + 1e-9) {
            continue;
        }
        let hit = voted.binary_search(&image).is_ok();
        let (cosine, sector) = nearest(&middles, &(away / distance));
        let should = distance >= NEAREST_M
            && distance <= farthest[sector] * (1.0 + 1e-9)
            && cosine >= SECTOR_COSINE
            && scene.is_in_picture(view, &point);
        if (hit || should) && label.undecided.binary_search(&image).is_err() {
            looks[sector].push((view.pass, view.viewpoint, hit));
        }
    }
    let sector = |(direction, mut looks): (Vector3<f64>, Vec<(u32, u32, bool)>)| {
        looks.sort_unstable();
        Sector { direction, looks: count_looks(&looks) }
    };
    middles.into_iter().zip(looks).map(sector).collect()
}

/// The middles of the sectors that some voters look from, and the farthest voter of each, m.
fn middles_of(scene: &Scene, point: &Vector3<f64>, voters: &[u32]) -> (Vec<Vector3<f64>>, Vec<f64>) {
    let middles = sector_middles(voters.iter().map(|&ray| direction_to(scene, ray, point)));
    let mut farthest = vec![0.0_f64; middles.len()];
    for &ray in voters {
        let (_, sector) = nearest(&middles, &direction_to(scene, ray, point));
        farthest[sector] = farthest[sector].max((scene.ray(ray).center - point).norm());
    }
    (middles, farthest)
}

/// The nearest middle of a sector to a direction: cosine and place in the list.
fn nearest(middles: &[Vector3<f64>], direction: &Vector3<f64>) -> (f64, usize) {
    let cosines = middles.iter().map(|middle| middle.dot(direction));
    cosines.zip(0..).fold((f64::NEG_INFINITY, 0), |best, this| if this.0 > best.0 { this } else { best })
}

/// All looks of some sectors, by pass.
#[must_use]
pub fn looks_of<'s>(sectors: impl Iterator<Item = &'s Sector>) -> Vec<Looks> {
    let mut looks: Vec<Looks> = sectors.flat_map(|sector| sector.looks.iter().copied()).collect();
    looks.sort_unstable_by_key(|looks| (looks.pass, looks.expected, looks.hits));
    let sum = |pass: &[Looks]| Looks {
        pass: pass[0].pass,
        expected: pass.iter().map(|looks| looks.expected).sum(),
        hits: pass.iter().map(|looks| looks.hits).sum(),
    };
    looks.chunk_by(|a, b| a.pass == b.pass).map(sum).collect()
}

/// Join images of one viewpoint, then viewpoints of one pass.
fn count_looks(sorted: &[(u32, u32, bool)]) -> Vec<Looks> {
    sorted
        .chunk_by(|a, b| a.0 == b.0)
        .map(|pass| {
            let viewpoints = pass.chunk_by(|a, b| a.1 == b.1);
            let hits = viewpoints.clone().filter(|images| images.iter().any(|image| image.2)).count();
            Looks { pass: pass[0].0, expected: viewpoints.count() as u32, hits: hits as u32 }
        })
        .collect()
}

impl Rates {
    /// Learn the recall and its spread over passes from the looks at labels that stay.
    #[must_use]
    pub fn learn(looks: &[Vec<Looks>]) -> Self {
        let sure: Vec<&Looks> = looks
            .iter()
            .filter(|passes| passes.iter().map(|p| p.hits).sum::<u32>() >= 8)
            .flatten()
            .filter(|pass| f64::from(pass.expected) >= LEAST_LOOKS_OF_PASS)
            .collect();
        let (hits, expected) =
            sure.iter().fold((0.0_f64, 0.0_f64), |(h, n), p| (h + f64::from(p.hits), n + f64::from(p.expected)));
        if expected < LEAST_LOOKS {
            let model::Rates { recall, concentration, .. } = model::Rates::GUESS;
            return Self { recall, concentration };
        }
        let recall = recall(hits / expected);
        // Method of moments: the variance of a pass's share is p (1 - p) (1 + (n - 1) / (1 + s)) / n.
        let mut excess = (0.0, 0.0);
        for pass in &sure {
            let n = f64::from(pass.expected);
            let share = f64::from(pass.hits) / n - recall;
            excess.0 += n * share * share - recall * (1.0 - recall);
            excess.1 += (n - 1.0) * recall * (1.0 - recall);
        }
        let correlation = f64::clamp(excess.0 / excess.1, CORRELATION.0, CORRELATION.1);
        Self { recall, concentration: 1.0 / correlation - 1.0 }
    }

    /// Logarithm of the likelihood of the hits of one pass at a real object: beta-binomial.
    #[must_use]
    pub fn log_likelihood(&self, looks: &Looks) -> f64 {
        let (a, b) = (self.recall * self.concentration, (1.0 - self.recall) * self.concentration);
        log_rising(a, looks.hits) + log_rising(b, looks.expected - looks.hits) - log_rising(a + b, looks.expected)
    }
}

/// `log(x (x + 1) ... (x + n - 1))`.
fn log_rising(x: f64, n: u32) -> f64 {
    (0..n).map(|k| (x + f64::from(k)).ln()).sum()
}

impl Sector {
    /// Whether its hits are more likely those of other things. At the edge of what can be seen, or behind a corner, any share
    /// of the looks may be hits.
    #[must_use]
    pub fn is_clutter(&self) -> bool {
        let (nothing, any) = (nothing(COINCIDENCE), Rates { recall: 0.5, concentration: 2.0 });
        let log_odds: f64 = self.looks.iter().map(|pass| nothing.log_likelihood(pass) - any.log_likelihood(pass)).sum();
        self.looks.iter().map(|pass| pass.hits).sum::<u32>() <= MOST_HITS_OF_CLUTTER && log_odds > CLUTTER_LOG_ODDS
    }
}

/// How often nothing is hit.
fn nothing(share: f64) -> Rates {
    Rates { recall: share, concentration: COINCIDENCE_CONCENTRATION }
}

/// The probability that each label exists.
///
/// Against it speaks that nothing is there, and the hits come from detections of other things: a small share of the looks,
/// again different from pass to pass. `chance` is the share that clutter alone gives.
/// `pruned` is how many others were found not to exist.
#[must_use]
pub fn probabilities(looks: &[Vec<Looks>], rates: &Rates, chance: &[f64], pruned: u64) -> Vec<f64> {
    let odds_against = ODDS_AGAINST * (1.0 + ODDS_PER_PRUNED * pruned as f64 / looks.len().max(1) as f64);
    looks
        .par_iter()
        .zip(chance)
        .map(|(passes, &chance)| {
            let nothing = nothing(chance + COINCIDENCE);
            let log_odds: f64 =
                passes.iter().map(|pass| rates.log_likelihood(pass) - nothing.log_likelihood(pass)).sum();
            1.0 / (1.0 + odds_against * (-log_odds).exp())
        })
        .collect()
}

/// The chance of a look having a detection in the gate of nothing: clutter a steradian, times the solid angle of
/// the gate, the mean over the voters.
#[must_use]
pub fn chance_of(label: &Label, scene: &Scene, spreads: &[Spread], gate_sigmas: f64, clutter_per_sr: f64) -> f64 {
    let areas = label.voters.iter().map(|&ray| {
        let depth = scene.ray(ray).project(&label.estimate.point).z;
        let variance = spreads[ray as usize].variance(depth) / scene.scale2[ray as usize];
        PI * gate_sigmas * gate_sigmas * variance
    });
    let mean = areas.sum::<f64>() / label.voters.len() as f64;
    (clutter_per_sr * mean).clamp(1e-4, 0.5)
}
