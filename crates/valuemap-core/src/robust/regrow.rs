//! Births from a ray: an object stands on a ray of no object where its class stands, and takes what it explains better, also from other objects.
//!
//! Rays of one approach hardly differ in direction: they propose no point, but size and height tell where one is. Where such an object has
//! lost a vote to another one, what is left of it is too little to be born, and the other one fits well enough to keep the vote. Only both
//! together have less J.

use rayon::prelude::*;
use rustc_hash::FxHashSet;

use super::assign::{gain_alone, places_of};
use super::births::VOTE_RANGE;
use super::energy::{NOBODY, Object, object, owners, unseen};
use super::few::{most_probable, votes_on};
use super::index::RayIndex;
use super::looks::Lookout;
use super::model::Model;
use crate::progress::{Halt, Progress};

/// Times that an object gathers rays of no other and is estimated again, at most.
const ROUNDS: usize = 3;
/// Votes of others that it tries to take, at most: those that it explains best.
const MOST_TAKEN: usize = 8;
/// J that falls by less stays as it is.
const LEAST_FALL: f64 = 1e-6;

/// An object that may be born, and what becomes of those whose votes it takes.
struct Birth {
    change: f64,
    born: Object,
    /// Each with what is left of it, if that is an object.
    others: Vec<(usize, Option<Object>)>,
}

/// Let objects be born of rays that no object has; whether any was. `index` has all rays.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn regrow(
    model: &Model<'_>,
    lookout: &Lookout,
    index: &RayIndex<'_>,
    rays: &[u32],
    objects: Vec<Object>,
    progress: &Progress,
) -> Result<(Vec<Object>, bool), Halt> {
    let owner = owners(model.scene, &objects);
    let garden = Garden { model, lookout, index, objects: &objects, owner: &owner };
    let free: Vec<u32> = rays.iter().copied().filter(|&ray| owner[ray as usize] == NOBODY).collect();
    let try_one = |&ray: &u32| {
        progress.check()?;
        Ok(garden.birth_on(ray))
    };
    let births: Vec<Option<Birth>> = free.par_iter().with_max_len(8).map(try_one).collect::<Result<_, Halt>>()?;
    let mut births: Vec<Birth> = births.into_iter().flatten().collect();
    births.sort_by(|a, b| a.change.total_cmp(&b.change).then(a.born.votes.cmp(&b.born.votes)));
    let (mut objects, mut any) = (objects.into_iter().map(Some).collect::<Vec<_>>(), false);
    let (mut taken, mut changed, mut born) = (FxHashSet::default(), FxHashSet::default(), Vec::new());
    for birth in births {
        let is_open = birth.born.votes.iter().all(|ray| !taken.contains(ray));
        if !is_open || birth.others.iter().any(|(other, _)| changed.contains(other)) {
            continue;
        }
        any = true;
        taken.extend(birth.born.votes.iter().copied());
        for (other, left) in birth.others {
            changed.insert(other);
            objects[other] = left;
        }
        born.push(birth.born);
    }
    let mut objects: Vec<Object> = objects.into_iter().flatten().chain(born).collect();
    objects.sort_by_key(|object| object.votes[0]);
    Ok((objects, any))
}

struct Garden<'a> {
    model: &'a Model<'a>,
    lookout: &'a Lookout,
    index: &'a RayIndex<'a>,
    objects: &'a [Object],
    /// The object of each ray.
    owner: &'a [u32],
}

impl Garden<'_> {
    /// The birth of an object on a ray, if J falls.
    fn birth_on(&self, ray: u32) -> Option<Birth> {
        let Self { model, lookout, .. } = *self;
        let class = model.class_of(ray);
        let is_free = |ray: u32| self.owner[ray as usize] == NOBODY;
        let mut born = unseen(model, vec![ray], most_probable(model, ray, class)?)?;
        for _ in 0..ROUNDS {
            let (votes, _) = votes_on(model, self.index, &born, ray, &is_free);
            if votes == born.votes {
                break;
            }
            born = unseen(model, votes, born.fit.point)?;
        }
        let mut born = born.with_looks(model, lookout, Vec::new())?;
        let mut birth = Vec::new();
        let mut change = born.energy;
        let taken = self.takes(&born);
        // Each is worth no more to it than it would be at its best.
        let at_most: f64 = taken.iter().map(|(_, gain)| gain).sum();
        if born.votes.len() + taken.len() < model.settings.min_votes as usize || change - 2.0 * at_most > -LEAST_FALL {
            return None;
        }
        for (vote, _) in taken {
            let other = self.owner[vote as usize] as usize;
            if birth.iter().any(|(i, _): &(usize, Option<Object>)| *i == other) {
                continue;
            }
            let mut votes = born.votes.clone();
            votes.push(vote);
            votes.sort_unstable();
            let Some(more) = object(model, lookout, votes, born.fit.point, Vec::new()) else { continue };
            let (left, lost) = self.without(other, vote);
            if more.energy - born.energy + lost < -LEAST_FALL {
                change += more.energy - born.energy + lost;
                born = more;
                birth.push((other, left));
            }
        }
        let is_one = born.votes.len() >= model.settings.min_votes as usize && born.energy < 0.0;
        (is_one && change < -LEAST_FALL).then_some(Birth { change, born, others: birth })
    }

    /// The votes of other objects that one explains better than clutter does, from images that show nothing else of it, with what each gains; the best first.
    fn takes(&self, born: &Object) -> Vec<(u32, f64)> {
        let model = self.model;
        let image = |ray: u32| model.scene.rays.image[ray as usize];
        let images: Vec<u32> = born.votes.iter().map(|&ray| image(ray)).collect();
        let may_be = |said| model.confusions.may_be(born.class, said);
        let range_m = model.settings.viability.max_range_m * VOTE_RANGE;
        let hits = self.index.hits_of_any(&places_of(model, born), &may_be, range_m);
        let mut takes: Vec<(u32, f64)> = hits
            .into_iter()
            .filter(|hit| self.owner[hit.ray as usize] != NOBODY && !images.contains(&hit.image))
            .map(|hit| (hit.ray, gain_alone(model, born, hit.ray)))
            .filter(|(_, gain)| *gain > 0.0)
            .collect();
        takes.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        let mut shown = FxHashSet::default();
        takes.retain(|(ray, _)| shown.insert(image(*ray)));
        takes.truncate(MOST_TAKEN);
        takes
    }

    /// What is left of an object without a vote, and by how much its J rises.
    fn without(&self, other: usize, vote: u32) -> (Option<Object>, f64) {
        let old = &self.objects[other];
        let votes: Vec<u32> = old.votes.iter().copied().filter(|&ray| ray != vote).collect();
        let is_enough = votes.len() >= self.model.settings.min_votes as usize;
        let left =
            is_enough.then(|| object(self.model, self.lookout, votes, old.fit.point, old.others.clone())).flatten();
        let left = left.filter(|left| left.energy < 0.0);
        let energy = left.as_ref().map_or(0.0, |left| left.energy);
        (left, energy - old.energy)
    }
}
