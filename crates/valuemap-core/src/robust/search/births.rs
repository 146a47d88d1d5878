//! Births: hypotheses among the rays of no object become objects if J falls.
//!
//! The best supported hypothesis takes the rays that it explains better than clutter does, equations (1) to (5) of
//! `docs/method.md`. Births go on with the rays that are left.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::propose::{Hypothesis, Who, propose};
use super::quick::quick_estimate;
use crate::progress::{Halt, Progress};
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::{Object, fitting, implied_size, size_of};
use crate::robust::model::Model;
use crate::robust::noise::index::{Hit, RayIndex};

/// Hypotheses that are tried side by side. More keep more threads busy, but more of them want rays that a better one has taken.
const BATCH: usize = 64;
/// Rounds of estimating and gathering votes again, at most. It bounds the work where votes come and go.
pub const MAX_ROUNDS: usize = 8;

/// Let objects be born among the rays of no object; `is_taken` (one per ray) says which rays have one, and is kept up to date. Also how many hypotheses
/// there were.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn births(
    model: &Model<'_>,
    lookout: &Lookout,
    rays: &[u32],
    is_taken: &mut [bool],
    progress: &Progress,
) -> Result<(Vec<Object>, u64), Halt> {
    let free: Vec<u32> = rays.iter().copied().filter(|&ray| !is_taken[ray as usize]).collect();
    let mut hypotheses = propose(model, &free, Who::All, progress)?;
    hypotheses.par_sort_by(|a, b| b.support.total_cmp(&a.support).then(a.rays.cmp(&b.rays)));
    let index = RayIndex::new(model.scene, &model.spreads, model.settings.gate_sigmas, free.into_iter());
    let nursery = Nursery { model, lookout, index: &index };
    let mut born: Vec<Object> = Vec::new();
    // The best hypotheses of all places are tried side by side; where two want the same ray, the better one has it, and
    // the other is tried again on what is left.
    for batch in hypotheses.chunks(BATCH) {
        progress.check()?;
        let tried: Vec<Option<Object>> =
            batch.par_iter().map(|hypothesis| nursery.try_one(hypothesis, is_taken)).collect();
        for (hypothesis, object) in batch.iter().zip(tried) {
            let is_free = |object: &Object| object.votes.iter().all(|&ray| !is_taken[ray as usize]);
            let settled = match object {
                Some(object) if !is_free(&object) => nursery.try_one(hypothesis, is_taken),
                object => object,
            };
            if let Some(object) = settled {
                for &ray in &object.votes {
                    is_taken[ray as usize] = true;
                }
                born.push(object);
            }
        }
    }
    Ok((born, hypotheses.len() as u64))
}

/// Where objects are born.
pub struct Nursery<'a> {
    /// The terms of J.
    pub model: &'a Model<'a>,
    /// All images by place.
    pub lookout: &'a Lookout,
    /// The rays that may vote.
    pub index: &'a RayIndex<'a>,
}

impl Nursery<'_> {
    fn try_one(&self, hypothesis: &Hypothesis, is_taken: &[bool]) -> Option<Object> {
        if hypothesis.rays.iter().any(|&ray| is_taken[ray as usize]) {
            return None;
        }
        self.grow(hypothesis.point, &hypothesis.rays, &|ray| !is_taken[ray as usize])
    }

    /// Gather votes at a point, estimate it on them, and again until they stay the same; nothing if J does not fall. `seeds` say how large
    /// the object is to begin with.
    #[must_use]
    pub fn grow(&self, start: Vector3<f64>, seeds: &[u32], may_vote: &dyn Fn(u32) -> bool) -> Option<Object> {
        let Self { model, lookout, index } = *self;
        let min_votes = model.settings.min_votes;
        let class = model.scene.rays.class[seeds[0] as usize];
        let range_m = model.reach_m();
        let sizes: Vec<f64> = seeds.iter().map(|&ray| implied_size(model, ray, &start)).collect();
        let mut ln_size = sizes.iter().sum::<f64>() / sizes.len() as f64;
        let mut point = start;
        let mut votes: Vec<u32> = Vec::new();
        for _ in 0..MAX_ROUNDS {
            let hits = index.all_hits(&point, class, range_m);
            let again = best_votes(model, class, &hits, &point, ln_size, may_vote);
            if again.len() < min_votes {
                return None;
            }
            if again == votes {
                break;
            }
            votes = again;
            point = quick_estimate(model.scene, &model.spreads, &votes, point)?;
            ln_size = size_of(model, &votes, &point);
        }
        // Votes that do not fit once the drift of their visit is known are clutter's.
        let found = fitting(model, lookout, votes, point)?;
        (found.energy < 0.0).then_some(found)
    }
}

/// Of some hits the rays, ascending, that are votes for an object of a class rather than clutter: the best of each image.
fn best_votes(
    model: &Model<'_>,
    class: u32,
    hits: &[Hit],
    point: &Vector3<f64>,
    ln_size: f64,
    may_vote: &dyn Fn(u32) -> bool,
) -> Vec<u32> {
    let votes_for = model.votes_for(class);
    let gain = |hit: &Hit| {
        let depth_m = model.scene.ray(hit.ray).project(point).z;
        let variance = model.spreads[hit.ray as usize].variance(depth_m);
        votes_for.gain(hit.ray, hit.chi2, variance * variance, depth_m, ln_size)
    };
    let may = hits.iter().filter(|hit| may_vote(hit.ray)).map(|hit| (hit, gain(hit)));
    let mut may: Vec<(&Hit, f64)> = may.filter(|(_, gain)| *gain > 0.0).collect();
    may.sort_by(|a, b| (a.0.image.cmp(&b.0.image)).then(b.1.total_cmp(&a.1)).then(a.0.ray.cmp(&b.0.ray)));
    may.dedup_by_key(|(hit, _)| hit.image);
    let mut votes: Vec<u32> = may.into_iter().map(|(hit, _)| hit.ray).collect();
    votes.sort_unstable();
    votes
}
