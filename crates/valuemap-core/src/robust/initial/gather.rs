//! Gathering: hypotheses become labels, the best supported one first.
//!
//! A point is estimated on its voters and gathers voters around the estimate, until they stay the same. Its voters are then
//! taken. Where there are many images, the rays of a part of them propose first; the rays that are left get further rounds.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::label::{Label, first_voter, from_voters};
use crate::progress::{Halt, Progress};
use crate::robust::model::Model;
use crate::robust::noise::index::RayIndex;
use crate::robust::parts::Part;
use crate::robust::search::births::MAX_ROUNDS;
use crate::robust::search::propose::{Hypothesis, MEETINGS, Who, propose};
use crate::robust::search::quick::quick_estimate;

/// Hypotheses that are polished side by side. More keep more threads busy, but more of them claim the same rays and are polished again.
const BATCH: usize = 16;
/// Who nominates, round after round, each time with the rays that are left over. A part comes first, which costs less where many images show the same; a round
/// of all that finds nothing is the last.
const ROUNDS: [Who; 4] = [Who::Part, Who::All, Who::All, Who::All];

/// Find labels among some rays (ascending), round after round, and count nominations and labels.
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
        let mut refusals = Refusals(vec![0; scene.rays.rays.len()]);
        // The best nominations of all places are polished side by side; where two claim the same ray, the better one
        // has it, and the other is polished again on what is left.
        for batch in nominations.chunks(BATCH) {
            progress.check()?;
            let polish_one = |nomination: &Hypothesis, claimed: &[bool], refusals: &Refusals| {
                if nomination.rays.iter().any(|&ray| claimed[ray as usize]) {
                    return Err(Vec::new());
                }
                let class = scene.rays.class[nomination.rays[0] as usize];
                let keep = |ray: u32| !claimed[ray as usize];
                polish(model, &index, nomination.point, class, range_m, &keep, refusals)
            };
            let polished: Vec<Result<Label, Vec<u32>>> =
                batch.par_iter().map(|nomination| polish_one(nomination, &claimed, &refusals)).collect();
            for (nomination, label) in batch.iter().zip(polished) {
                let is_free = |label: &Label| label.voters.iter().all(|&ray| !claimed[ray as usize]);
                let settled = match label {
                    Ok(label) if !is_free(&label) => polish_one(nomination, &claimed, &refusals),
                    label => label,
                };
                match settled {
                    Ok(label) => {
                        for &ray in &label.voters {
                            claimed[ray as usize] = true;
                        }
                        labels.push(label);
                    }
                    Err(gathered) => refusals.count(&gathered),
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

/// How often each ray was gathered for no label. Where gates are as wide as streets, as with the largest starts of the noise, each hypothesis would
/// gather most rays otherwise.
struct Refusals(Vec<u8>);

impl Refusals {
    fn count(&mut self, gathered: &[u32]) {
        for &ray in gathered {
            self.0[ray as usize] = self.0[ray as usize].saturating_add(1);
        }
    }

    /// Whether rays are not worth another try: each of them was gathered for nothing as often as it is tried with others.
    fn are_enough(&self, gathered: &[u32]) -> bool {
        gathered.iter().all(|&ray| usize::from(self.0[ray as usize]) >= MEETINGS)
    }
}

/// Estimate a point on its voters and gather voters from the estimate, quickly, until they stay the same; then once with
/// the estimate that settling uses, without the voters that disagree.
///
/// What it gathered last if fewer than `min_votes` remain, or only rays that made no label often enough.
fn polish(
    model: &Model<'_>,
    index: &RayIndex<'_>,
    start: Vector3<f64>,
    class: u32,
    range_m: f64,
    keep: &dyn Fn(u32) -> bool,
    refusals: &Refusals,
) -> Result<Label, Vec<u32>> {
    let Model { scene, noise, settings, .. } = *model;
    let min_votes = settings.min_votes;
    let rounds = if settings.has(Part::Polishing) { MAX_ROUNDS } else { 0 };
    let voters_at = |point: &Vector3<f64>| -> Vec<u32> {
        let keep = |ray: u32| keep(ray) && model.may_tell(ray, point);
        index.hits(point, class, range_m, &keep).iter().map(|hit| hit.ray).collect()
    };
    let mut gathered = voters_at(&start);
    let mut point = start;
    for _ in 0..rounds {
        if gathered.len() < min_votes || refusals.are_enough(&gathered) {
            return Err(gathered);
        }
        let Some(estimate) = quick_estimate(scene, index.spreads(), &gathered, point) else { return Err(gathered) };
        point = estimate;
        let again = voters_at(&point);
        if again == gathered {
            break;
        }
        gathered = again;
    }
    if gathered.len() < min_votes {
        return Err(gathered);
    }
    let label = from_voters(scene, noise, index.gate_sigmas(), gathered.clone(), point);
    label.filter(|label| label.voters.len() >= min_votes).ok_or(gathered)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::street;

    #[test]
    fn what_was_gathered_for_nothing_again_and_again_is_not_tried_any_more() {
        let at = Vector3::new(30.0, 4.0, 3.0);
        let scene = street::street(12, 2.0, &[at], &[[0.0, 0.0]]);
        let model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
        let rays = scene.usable_rays();
        let index = RayIndex::new(&scene, &model.spreads, street::SETTINGS.gate_sigmas, rays.iter().copied());
        let mut refusals = Refusals(vec![0; rays.len()]);
        let voters = |refusals: &Refusals| {
            let label = polish(&model, &index, at, 0, model.reach_m(), &|_| true, refusals);
            label.map(|label| label.voters.len())
        };
        // One ray that is left is enough.
        (0..MEETINGS).for_each(|_| refusals.count(&rays[1..]));
        (1..MEETINGS).for_each(|_| refusals.count(&rays[..1]));
        assert_eq!(voters(&refusals), Ok(rays.len()));
        refusals.count(&rays[..1]);
        assert_eq!(voters(&refusals), Err(rays));
    }
}
