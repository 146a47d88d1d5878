//! Gathering: hypotheses become labels, the best supported one first.
//!
//! A point is estimated on its voters and gathers voters around the estimate, until they stay the same. Its voters are then
//! taken. Where there are many images, the rays of a part of them propose first; the rays that are left get further rounds.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::label::{Label, first_voter, from_voters};
use crate::progress::{Halt, Progress};
use crate::robust::index::RayIndex;
use crate::robust::model::Model;
use crate::robust::parts::Part;
use crate::robust::propose::{Hypothesis, Who, propose};
use crate::robust::quick::quick_estimate;

/// Hypothesiss that are polished side by side.
const BATCH: usize = 16;
/// Who nominates, round after round, each time with the rays that are left over.
const ROUNDS: [Who; 4] = [Who::Part, Who::All, Who::All, Who::All];
/// Rounds of estimating and gathering voters again, at most.
const MAX_ROUNDS: usize = 8;

/// Find labels among some rays (ascending) with a given noise, round after round, and count nominations and labels;
/// `spreads` are those of all rays of the scene.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn gather(model: &Model<'_>, rays: &[u32], progress: &Progress) -> Result<(Vec<Label>, [u64; 2]), Halt> {
    let Model { scene, ref spreads, settings, .. } = *model;
    let range_m = model.reach_m();
    let mut labels: Vec<Label> = Vec::new();
    let mut claimed = vec![false; scene.rays.rays.len()];
    let mut counts = [0_u64; 2];
    for who in ROUNDS {
        let free: Vec<u32> = rays.iter().copied().filter(|&ray| !claimed[ray as usize]).collect();
        let mut nominations = propose(model, &free, who, progress)?;
        nominations.par_sort_by(|a, b| b.support.total_cmp(&a.support).then(a.rays.cmp(&b.rays)));
        counts[0] += nominations.len() as u64;
        let index = RayIndex::new(scene, spreads, settings.gate_sigmas, free.into_iter());
        let before = labels.len();
        // The best nominations of all places are polished side by side; where two claim the same ray, the better one
        // has it, and the other is polished again on what is left.
        for batch in nominations.chunks(BATCH) {
            progress.check()?;
            let polish_one = |nomination: &Hypothesis, claimed: &[bool]| {
                if nomination.rays.iter().any(|&ray| claimed[ray as usize]) {
                    return None;
                }
                let class = scene.rays.class[nomination.rays[0] as usize];
                let keep = |ray: u32| !claimed[ray as usize];
                polish(model, &index, nomination.point, class, range_m, &keep)
            };
            let polished: Vec<Option<Label>> =
                batch.par_iter().map(|nomination| polish_one(nomination, &claimed)).collect();
            for (nomination, label) in batch.iter().zip(polished) {
                let is_free = |label: &Label| label.voters.iter().all(|&ray| !claimed[ray as usize]);
                let settled = match label {
                    Some(label) if !is_free(&label) => polish_one(nomination, &claimed),
                    label => label,
                };
                if let Some(label) = settled {
                    for &ray in &label.voters {
                        claimed[ray as usize] = true;
                    }
                    labels.push(label);
                }
            }
        }
        if who == Who::All && labels.len() == before {
            break;
        }
    }
    counts[1] = labels.len() as u64;
    labels.sort_by_cached_key(first_voter);
    Ok((labels, counts))
}

/// Estimate a point on its voters and gather voters from the estimate, quickly, until they stay the same; then once with
/// the estimate that settling uses, without the voters that disagree.
///
/// Nothing if fewer than `min_votes` remain.
#[must_use]
fn polish(
    model: &Model<'_>,
    index: &RayIndex<'_>,
    start: Vector3<f64>,
    class: u32,
    range_m: f64,
    keep: &dyn Fn(u32) -> bool,
) -> Option<Label> {
    let Model { scene, noise, settings, .. } = *model;
    let min_votes = settings.min_votes as usize;
    let rounds = if settings.has(Part::Polishing) { MAX_ROUNDS } else { 0 };
    let voters_at = |point: &Vector3<f64>| -> Vec<u32> {
        let keep = |ray: u32| keep(ray) && model.may_tell(ray, point);
        index.hits(point, class, range_m, &keep).iter().map(|hit| hit.ray).collect()
    };
    let mut gathered = voters_at(&start);
    let mut point = start;
    for _ in 0..rounds {
        if gathered.len() < min_votes {
            return None;
        }
        point = quick_estimate(scene, index.spreads(), &gathered, point)?;
        let again = voters_at(&point);
        if again == gathered {
            break;
        }
        gathered = again;
    }
    if gathered.len() < min_votes {
        return None;
    }
    let label = from_voters(scene, noise, index.gate_sigmas(), gathered, point)?;
    (label.voters.len() >= min_votes).then_some(label)
}
