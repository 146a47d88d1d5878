//! The loop of the initial map: labels compete for the rays, round after round, and those that J is lower without are dropped.

use rayon::prelude::*;

use super::adjust::adjust;
use super::associate::Association;
use super::exchange::exchange;
use super::gather::gather;
use super::label::{Label, first_voter};
use super::settle::{fuse, split};
use super::{Schedule, Tally, placed};
use crate::progress::{Halt, Progress};
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::object;
use crate::robust::model::Model;
use crate::robust::noise::index::RayIndex;
use crate::robust::parts::Part;

/// Rounds of dropping and giving back at the end, at most. It bounds the work: they end where nothing is dropped any more.
const MAX_PRUNE_ROUNDS: usize = 6;

/// Where labels compete for the rays.
pub(super) struct Solver<'a> {
    model: &'a Model<'a>,
    association: Association<'a>,
}

impl<'a> Solver<'a> {
    /// Begin with some rays (ascending) of a scene.
    pub(super) fn new(model: &'a Model<'a>, rays: impl Iterator<Item = u32>) -> Self {
        let Model { scene, noise, ref spreads, settings, .. } = *model;
        let index = RayIndex::new(scene, spreads, settings.gate_sigmas, rays);
        Self { model, association: Association::new(scene, noise, index, model.reach_m()) }
    }

    /// Find labels among all rays, beginning with those that were found already.
    pub(super) fn solve(
        &mut self,
        begun: Vec<Label>,
        schedule: &Schedule,
        tally: &mut Tally,
        progress: &Progress,
    ) -> Result<Vec<Label>, Halt> {
        let lookout = Lookout::new(self.model.scene, self.model.settings.viability.max_range_m);
        let mut labels = self.associate(begun, tally, progress)?;
        // What a dropped label gives back, and what settled labels leave, may be seen more clearly now.
        for _ in 0..schedule.gatherings {
            let before = labels.len();
            let new = self.left_over(&labels, schedule, tally, progress)?;
            // Where others have most detections already, what is nothing by itself is not to take them.
            labels.extend(if labels.is_empty() { new } else { self.worth_it(&lookout, new, tally) });
            labels.sort_by_cached_key(first_voter);
            for _ in 0..schedule.rounds {
                labels = self.settle(labels, schedule.splits, tally, progress)?;
            }
            labels = self.prune(&lookout, labels, schedule, tally, progress)?;
            if labels.len() <= before {
                break;
            }
        }
        Ok(labels)
    }

    /// Drop the labels that J is lower without, and let the others compete for their votes: what one gives back may be just what another one lacks.
    fn prune(
        &mut self,
        lookout: &Lookout,
        mut labels: Vec<Label>,
        schedule: &Schedule,
        tally: &mut Tally,
        progress: &Progress,
    ) -> Result<Vec<Label>, Halt> {
        for _ in 0..MAX_PRUNE_ROUNDS {
            let before = labels.len();
            labels = self.worth_it(lookout, labels, tally);
            if labels.len() == before {
                break;
            }
            labels = self.settle(labels, schedule.splits, tally, progress)?;
        }
        Ok(labels)
    }

    /// Labels of the rays that no label has; if there are others, these compete among themselves first.
    fn left_over(
        &self,
        labels: &[Label],
        schedule: &Schedule,
        tally: &mut Tally,
        progress: &Progress,
    ) -> Result<Vec<Label>, Halt> {
        let mut is_taken = vec![false; self.model.scene.rays.rays.len()];
        for &ray in labels.iter().flat_map(|label| &label.voters) {
            is_taken[ray as usize] = true;
        }
        let free: Vec<u32> = (0..is_taken.len() as u32).filter(|&ray| !is_taken[ray as usize]).collect();
        let (mut new, [nominations, accepted]) = gather(self.model, &free, progress)?;
        tally.nominations += nominations;
        tally.accepted += accepted;
        if !labels.is_empty() {
            let mut inner = Solver::new(self.model, free.into_iter());
            for _ in 0..schedule.rounds {
                new = inner.settle(new, schedule.splits, tally, progress)?;
            }
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
        let labels = self.associate(exchange(model, labels), tally, progress)?;
        let associated = labels.len();
        let labels = adjust(model, &labels, progress)?;
        tally.outvoted += (associated - labels.len()) as u64;
        let labels = if may_split { split(model, labels) } else { labels };
        Ok(if model.settings.has(Part::Merging) { fuse(model, labels) } else { labels })
    }

    /// All labels compete for all rays; those that get too few are dropped.
    fn associate(&mut self, labels: Vec<Label>, tally: &mut Tally, progress: &Progress) -> Result<Vec<Label>, Halt> {
        let before = labels.len();
        let mut labels = self.association.associate(labels, progress)?;
        labels.retain(|label| label.voters.len() >= self.model.settings.min_votes);
        tally.outvoted += (before - labels.len()) as u64;
        Ok(labels)
    }

    /// The labels that J is not lower without.
    fn worth_it(&self, lookout: &Lookout, labels: Vec<Label>, tally: &mut Tally) -> Vec<Label> {
        let before = labels.len();
        let lowers_energy = |label: &Label| {
            let (votes, point) = placed(label);
            object(self.model, lookout, votes, point).is_some_and(|object| object.energy < 0.0)
        };
        let labels: Vec<Label> = labels.into_par_iter().filter(lowers_energy).collect();
        tally.pruned += (before - labels.len()) as u64;
        labels
    }
}
