//! The loop of the initial map: labels compete for the rays, round after round, and those that probably do not exist are dropped.

use std::sync::{Arc, OnceLock};

use nalgebra::Vector3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::adjust::adjust;
use super::associate::Association;
use super::existence::{Looks, Rates, Sector, sectors};
use super::gather::gather;
use super::label::{Label, fingerprint};
use super::{Schedule, Tally, exchange, existence, label, settle, swap};
use crate::progress::{Halt, Progress};
use crate::robust::energy::looks::Lookout;
use crate::robust::model::Model;
use crate::robust::noise::index::RayIndex;
use crate::robust::parts::Part;
use crate::robust::scene::Frustum;

/// Labels are dropped below these multiples of the probability that is asked for, one after the other, and then below that. The least probable go first, as
/// what they give back may be what a doubtful one lacks.
const PRUNED_BELOW: [f64; 3] = [1e-5, 1e-2, 0.3];

/// Rounds of dropping and giving back at the end, at most. It bounds the work: they end where nothing is dropped any more.
const MAX_PRUNE_ROUNDS: usize = 6;

/// Where labels compete for the rays.
pub(super) struct Solver<'a> {
    model: &'a Model<'a>,
    association: Association<'a>,
    lookout: OnceLock<Lookout>,
    /// The sectors of the labels as they last were.
    seen_from: FxHashMap<(u64, u64), Arc<[Sector]>>,
}

impl<'a> Solver<'a> {
    /// Begin with some rays (ascending) of a scene.
    pub(super) fn new(model: &'a Model<'a>, rays: impl Iterator<Item = u32>) -> Self {
        let Model { scene, noise, ref spreads, settings, .. } = *model;
        let index = RayIndex::new(scene, spreads, settings.gate_sigmas, rays);
        let range_m = model.reach_m();
        Self {
            model,
            association: Association::new(scene, noise, index, range_m),
            lookout: OnceLock::new(),
            seen_from: FxHashMap::default(),
        }
    }

    /// Find labels among all rays, beginning with those that were found already.
    pub(super) fn solve(
        &mut self,
        begun: Vec<Label>,
        schedule: &Schedule,
        tally: &mut Tally,
        progress: &Progress,
    ) -> Result<Vec<Label>, Halt> {
        let mut labels = self.associate(begun, tally, progress)?;
        // What a pruned label gives back, and what settled labels leave, may be seen more clearly now.
        for _ in 0..schedule.sessions {
            let before = labels.len();
            let new = self.left_over(&labels, schedule.rounds, tally, progress)?;
            let is_raw = labels.is_empty();
            labels = if is_raw { new } else { self.admit(labels, new, tally) };
            labels.sort_by_cached_key(label::first_voter);
            for _ in 0..schedule.rounds {
                labels = self.settle(labels, true, tally, progress)?;
            }
            labels = self.swap(labels, schedule.swaps, tally, progress)?.0;
            labels = self.prune(labels, is_raw, tally, progress)?;
            let is_any;
            (labels, is_any) = self.swap(labels, schedule.swaps, tally, progress)?;
            if is_any {
                labels = self.prune(labels, false, tally, progress)?;
            }
            if labels.len() <= before {
                break;
            }
        }
        Ok(labels)
    }

    /// Labels of the rays that no label has; if there are others, these compete among themselves first, in some rounds.
    fn left_over(
        &self,
        labels: &[Label],
        rounds: usize,
        tally: &mut Tally,
        progress: &Progress,
    ) -> Result<Vec<Label>, Halt> {
        let scene = self.model.scene;
        let mut is_taken = vec![false; scene.rays.rays.len()];
        for &ray in labels.iter().flat_map(|label| &label.voters) {
            is_taken[ray as usize] = true;
        }
        let free: Vec<u32> = (0..is_taken.len() as u32).filter(|&ray| !is_taken[ray as usize]).collect();
        let (mut new, [nominations, accepted]) = gather(self.model, &free, progress)?;
        tally.nominations += nominations;
        tally.accepted += accepted;
        if !labels.is_empty() {
            let mut inner = Solver::new(self.model, free.into_iter());
            for _ in 0..rounds {
                new = inner.settle(new, true, tally, progress)?;
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
    pub(super) fn settle(
        &mut self,
        labels: Vec<Label>,
        may_split: bool,
        tally: &mut Tally,
        progress: &Progress,
    ) -> Result<Vec<Label>, Halt> {
        progress.check()?;
        let model = self.model;
        let labels = exchange::exchange(model, labels);
        let labels = self.associate(labels, tally, progress)?;
        let associated = labels.len();
        let labels = adjust(model, &labels, progress)?;
        tally.outvoted += (associated - labels.len()) as u64;
        let labels = if may_split { settle::split(model, labels) } else { labels };
        Ok(if model.settings.has(Part::Merging) { settle::fuse(model, labels) } else { labels })
    }

    /// All labels compete for all rays; those that get too few are dropped.
    fn associate(&mut self, labels: Vec<Label>, tally: &mut Tally, progress: &Progress) -> Result<Vec<Label>, Halt> {
        let before = labels.len();
        let mut labels = self.association.associate(labels, progress)?;
        labels.retain(|label| label.voters.len() >= self.model.settings.min_votes as usize);
        tally.outvoted += (before - labels.len()) as u64;
        Ok(labels)
    }

    /// Let neighbors take over what the other one explains better, round after round; whether there was anything.
    fn swap(
        &mut self,
        mut labels: Vec<Label>,
        rounds: usize,
        tally: &mut Tally,
        progress: &Progress,
    ) -> Result<(Vec<Label>, bool), Halt> {
        for round in 0..rounds {
            let is_any;
            (labels, is_any) = swap::swap_votes(self.model, &self.association, labels, progress)?;
            if !is_any {
                return Ok((labels, round > 0));
            }
            labels = self.settle(labels, true, tally, progress)?;
        }
        Ok((labels, rounds > 0))
    }

    fn sectors_of(&self, label: &Label) -> Arc<[Sector]> {
        let lookout = || Lookout::new(self.model.scene, self.model.settings.viability.max_range_m);
        sectors(self.lookout.get_or_init(lookout), self.model.scene, label).into()
    }

    /// The sectors that each label is seen from.
    pub(super) fn sectors(&mut self, labels: &[Label]) -> Vec<Arc<[Sector]>> {
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
        let existences = judge(self.model, &sectors, &labels, tally.pruned);
        let before = labels.len();
        let admitted = labels.into_iter().zip(existences).enumerate();
        let admitted =
            admitted.filter(|(i, (_, existence))| *i < old || *existence >= self.model.settings.min_existence);
        let labels: Vec<Label> = admitted.map(|(_, (label, _))| label).collect();
        tally.pruned += (before - labels.len()) as u64;
        labels
    }

    /// Take votes away from labels that look as if they were not to be seen from there. Also the sectors of those left.
    fn look_around(&mut self, labels: Vec<Label>, tally: &mut Tally) -> (Vec<Label>, Vec<Arc<[Sector]>>) {
        let before = labels.len();
        let sectors = self.sectors(&labels);
        let of_label = |(label, sectors): (Label, Arc<[Sector]>)| {
            let clutter: Vec<Vector3<f64>> =
                sectors.iter().filter(|sector| sector.is_clutter()).map(|sector| sector.direction).collect();
            if clutter.is_empty() {
                return Some((label, sectors));
            }
            let unseen_from = [label.unseen_from.as_slice(), &clutter].concat();
            let label = Label { unseen_from: unseen_from.clone(), ..label };
            let seen = label.voters.iter().copied().filter(|&ray| label.faces(self.model.scene, ray)).collect();
            let start = label.estimate.point;
            let found =
                label::from_voters(self.model.scene, self.model.noise, self.model.settings.gate_sigmas, seen, start)?;
            let enough = found.voters.len() >= self.model.settings.min_votes as usize;
            let left = enough.then_some(Label { undecided: label.undecided, unseen_from, ..found })?;
            let sectors = self.sectors_of(&left);
            Some((left, sectors))
        };
        let (labels, sectors): (Vec<Label>, Vec<_>) =
            labels.into_par_iter().zip(sectors).filter_map(of_label).collect::<Vec<_>>().into_iter().unzip();
        tally.pruned += (before - labels.len()) as u64;
        (labels, sectors)
    }

    /// Drop the labels that probably do not exist, the least probable first: what they give back may be just what a doubtful
    /// one lacks.
    fn prune(
        &mut self,
        mut labels: Vec<Label>,
        is_raw: bool,
        tally: &mut Tally,
        progress: &Progress,
    ) -> Result<Vec<Label>, Halt> {
        if is_raw {
            for share in PRUNED_BELOW {
                labels = self.drop_below(share, labels, tally, progress)?;
            }
        }
        for _ in 0..MAX_PRUNE_ROUNDS {
            let dropped = tally.pruned;
            labels = self.drop_below(1.0, labels, tally, progress)?;
            if tally.pruned == dropped {
                break;
            }
        }
        Ok(labels)
    }

    /// Drop the labels that are less probable than a multiple of what is asked for, and let the others compete for their votes.
    fn drop_below(
        &mut self,
        share: f64,
        labels: Vec<Label>,
        tally: &mut Tally,
        progress: &Progress,
    ) -> Result<Vec<Label>, Halt> {
        let (labels, sectors) = self.look_around(labels, tally);
        let existences = judge(self.model, &sectors, &labels, tally.pruned);
        let before = labels.len();
        let judged = labels.into_iter().zip(existences);
        let existing = judged.filter(|(_, existence)| *existence >= share * self.model.settings.min_existence);
        let labels: Vec<Label> = existing.map(|(label, _)| label).collect();
        tally.pruned += (before - labels.len()) as u64;
        if labels.len() == before { Ok(labels) } else { self.settle(labels, false, tally, progress) }
    }
}

/// The probability that each label of a scene exists.
fn judge(model: &Model<'_>, sectors: &[Arc<[Sector]>], labels: &[Label], pruned: u64) -> Vec<f64> {
    let Model { scene, ref spreads, settings, .. } = *model;
    let looks: Vec<Vec<Looks>> = sectors.par_iter().map(|sectors| existence::looks_of(sectors.iter())).collect();
    let rates = Rates::learn(&looks);
    let claimed: usize = labels.iter().map(|label| label.voters.len()).sum();
    let clutter_per_image = (scene.rays.rays.len() - claimed) as f64 / scene.views.len() as f64;
    let solid_angle = scene.frusta.iter().map(Frustum::searched_sr).sum::<f64>() / scene.frusta.len() as f64;
    let clutter_per_sr = clutter_per_image / solid_angle;
    let chance: Vec<f64> = labels
        .par_iter()
        .map(|label| existence::chance_of(label, scene, spreads, settings.gate_sigmas, clutter_per_sr))
        .collect();
    existence::probabilities(&looks, &rates, &chance, pruned)
}
