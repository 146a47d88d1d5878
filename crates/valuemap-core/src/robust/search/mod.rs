//! The search for the map with the least J: moves from an initial map, committed only if J falls.
//!
//! Each round has assignment, destroy and repair, births, and merges and swaps, until no move lowers J. Births with votes of
//! others come last. Where all moves are not worth their time, there is one round of assignment, deaths, dissolutions and births. At the end images that show both of
//! two neighbours say which is which. A search that
//! `learns` learns the classes of its model anew in each round.

pub mod assign;
pub mod births;
pub mod dissolve;
pub mod exclude;
pub mod few;
pub mod foresee;
pub mod propose;
pub mod quick;
pub mod rearrange;
pub mod regrow;
pub mod repair;
pub mod untangle;

use std::sync::Arc;

use rayon::prelude::*;

use crate::progress::{Halt, Progress};
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::{Object, Placed, are_taken, object, unseen};
use crate::robust::learn::learn;
use crate::robust::learn::tails::of_rays;
use crate::robust::model::Model;
use crate::robust::noise::index::RayIndex;
use crate::robust::parts::Part;
use assign::assign;
use births::births;
use dissolve::dissolve;
use exclude::exclude;
use rearrange::{TriedPairs, rearrange_pairs};
use regrow::regrow;
use repair::repair;
use untangle::untangle;

/// Rounds, at most. It bounds the work, and more changed nothing beyond chance where images are sparse (`docs/notes/method.md`).
const ROUNDS: usize = 6;
/// Steps of a search with all moves at most, as progress counts them: the four kinds of moves of each round.
pub const SEARCH_STEPS: usize = 4 * ROUNDS;
/// Steps of a search in which objects compete and are born once.
pub const STEPS_OF_ONCE: usize = 2;

/// What became of everything that was proposed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Tally {
    /// Points proposed by rays.
    pub hypotheses: u64,
    /// Objects that were born.
    pub births: u64,
    /// Objects that were not worth it in the end.
    pub deaths: u64,
}

/// How far the search goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Depth {
    /// What is there competes, and dies if J falls.
    Shallow,
    /// That, and then what is left over gives birth.
    Once,
    /// All moves, until none lowers J.
    Deep,
}

/// Objects that are born of what some objects leave over of some rays, and how many hypotheses there were.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn born_of_rest(
    model: &Model<'_>,
    lookout: &Lookout,
    rays: &[u32],
    objects: &[Object],
    progress: &Progress,
) -> Result<(Vec<Object>, u64), Halt> {
    if !model.settings.has(Part::Births) {
        return Ok((Vec::new(), 0));
    }
    births(model, lookout, rays, &mut are_taken(model.scene, objects), progress)
}

/// The map of some rays with the least J that is found from what is there to begin with, and what was born and died.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn search(
    model: &mut Model<'_>,
    rays: &[u32],
    begun: Vec<Placed>,
    depth: Depth,
    learns: bool,
    progress: &Progress,
) -> Result<(Vec<Object>, Tally), Halt> {
    let mut tally = Tally::default();
    let lookout = Lookout::new(model.scene, model.settings.viability.max_range_m);
    let spreads = Arc::clone(&model.spreads);
    let index = RayIndex::new(model.scene, &spreads, model.settings.gate_sigmas, rays.iter().copied());
    // Who should have seen objects tells what classes are like; of each it is asked below.
    let begin = |(votes, point): Placed| {
        if learns { object(model, &lookout, votes, point) } else { unseen(model, votes, point) }
    };
    let mut objects: Vec<Object> = begun.into_par_iter().filter_map(begin).collect();
    let mut tried = TriedPairs::default();
    let rounds = if depth == Depth::Deep { ROUNDS } else { 1 };
    for round in 0..rounds {
        if learns {
            learn(model, &lookout, rays, &objects);
        } else {
            model.ln_tails = of_rays(model, &lookout, rays, &objects);
        }
        let model: &Model<'_> = model;
        let again = |o: Object| object(model, &lookout, o.votes, o.fit.point);
        objects = objects.into_par_iter().filter_map(again).filter(|object| object.energy < 0.0).collect();
        let before = objects.len();
        let has = |part: Part| model.settings.has(part);
        let (assigned, mut any) =
            if has(Part::Assignment) { assign(model, &lookout, &index, objects, progress)? } else { (objects, false) };
        objects = assigned;
        tally.deaths += (before - objects.len()) as u64;
        progress.advance()?;
        if depth == Depth::Once && has(Part::Dissolution) {
            let (dissolved, better) = dissolve(model, &lookout, &index, objects, progress)?;
            any |= better;
            objects = dissolved;
        }
        if depth == Depth::Deep {
            if has(Part::Repair) {
                let (repaired, better) = repair(model, &lookout, &index, objects, round as u64, progress)?;
                any |= better;
                objects = repaired;
            }
            progress.advance()?;
        }
        if depth >= Depth::Once {
            let (born, hypotheses) = born_of_rest(model, &lookout, rays, &objects, progress)?;
            tally.hypotheses += hypotheses;
            tally.births += born.len() as u64;
            any |= !born.is_empty();
            objects.extend(born);
            progress.advance()?;
        }
        // Last, as pairs take the longest where objects are dense: what is cheaper leaves them less to do.
        if depth == Depth::Deep {
            let (rearranged, better) = rearrange_pairs(model, &lookout, &index, objects, &mut tried, progress)?;
            any |= better;
            objects = rearranged;
            progress.advance()?;
        }
        // What is left of objects that lost votes to others, once nothing else helps: all rays that are left over are tried.
        if depth == Depth::Deep && has(Part::TakenVotes) && (!any || round + 1 == rounds) {
            let (regrown, better) = regrow(model, &lookout, rays, objects, progress)?;
            any |= better;
            objects = regrown;
        }
        if !any {
            break;
        }
    }
    if model.settings.has(Part::Untangling) && depth >= Depth::Once {
        objects = untangle(model, &lookout, objects, progress)?;
    }
    if model.settings.has(Part::Exclusion) {
        objects = exclude(model, &lookout, objects, progress)?;
    }
    objects.retain(|object| object.energy < 0.0);
    objects.sort_by_key(|object| object.votes[0]);
    Ok((objects, tally))
}
