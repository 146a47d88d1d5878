//! Births with votes of others: an object is born on a ray of no object and takes votes from other objects, if J of all falls.
//!
//! Rays of one approach hardly differ in direction and propose no point, but size and height locate an object on one of them. If
//! it has lost a vote to another object, what is left is too little for a birth, and the other object fits well enough to keep
//! the vote. Only both changes together lower J.
//!
//! Without a vote of others it stands where objects of few votes stand, and must be worth what they must: many rays from far away agree on some place at
//! the usual height by chance.

use rayon::prelude::*;
use rustc_hash::FxHashSet;

use super::assign::gain_alone;
use super::few::{ROUNDS, ln_terms, most_probable, votes_on};
use super::repair::MOST_VISITS;
use crate::progress::{Halt, Progress};
use crate::robust::energy::estimate::visits;
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::{LEAST_GAIN_OF_MOVE, NOBODY, Object, object, owners, unseen};
use crate::robust::learn::company::Sure;
use crate::robust::model::Model;
use crate::robust::noise::index::RayIndex;

/// Votes of others that it tries to take, at most: those that it explains best. It bounds the work: each costs two estimates, of both objects.
const MOST_TAKEN: usize = 8;

/// An object that may be born, and what becomes of those whose votes it takes.
struct Birth {
    change: f64,
    born: Object,
    /// Each with what is left of it, if that is an object.
    others: Vec<(usize, Option<Object>)>,
}

/// Let objects be born of rays that no object has and votes that others lose; whether any was. Objects of many visits lose none.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn regrow(
    model: &Model<'_>,
    lookout: &Lookout,
    rays: &[u32],
    objects: Vec<Object>,
    progress: &Progress,
) -> Result<(Vec<Object>, bool), Halt> {
    let owner = owners(model.scene, &objects);
    let of_few = open_to_others(model, &objects);
    let free: Vec<u32> = rays.iter().copied().filter(|&ray| owner[ray as usize] == NOBODY).collect();
    let index_of =
        |rays: &[u32]| RayIndex::new(model.scene, &model.spreads, model.settings.gate_sigmas, rays.iter().copied());
    let garden = Garden {
        model,
        lookout,
        free: &index_of(&free),
        of_few: &index_of(&of_few),
        objects: &objects,
        owner: &owner,
        sure: &Sure::of_classes(model, &objects),
    };
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

/// The votes of objects of few visits: rays of two objects do not meet in one place on many.
fn open_to_others(model: &Model<'_>, objects: &[Object]) -> Vec<u32> {
    let is_of_few = |object: &&Object| visits(model.scene, &object.votes).count() <= MOST_VISITS;
    objects.iter().filter(is_of_few).flat_map(|object| object.votes.iter().copied()).collect()
}

struct Garden<'a> {
    model: &'a Model<'a>,
    lookout: &'a Lookout,
    /// The rays of no object.
    free: &'a RayIndex<'a>,
    /// The votes of the objects of few visits.
    of_few: &'a RayIndex<'a>,
    objects: &'a [Object],
    /// The object of each ray.
    owner: &'a [u32],
    /// The sure objects of each class.
    sure: &'a [Sure],
}

impl Garden<'_> {
    /// The birth of an object on a ray, if J falls.
    fn birth_on(&self, ray: u32) -> Option<Birth> {
        let Self { model, lookout, .. } = *self;
        let class = model.class_of(ray);
        let mut born = unseen(model, vec![ray], most_probable(model, ray, class)?)?;
        for _ in 0..ROUNDS {
            let (votes, _) = votes_on(model, self.free, &born, ray, &|_| true);
            if votes == born.votes {
                break;
            }
            born = unseen(model, votes, born.fit.point)?;
        }
        let taken = self.takes(&born);
        // Each is worth no more to it than it would be at its best.
        let at_most: f64 = taken.iter().map(|(_, gain)| gain).sum();
        let is_in_vain = |born: &Object| born.energy - 2.0 * at_most > -LEAST_GAIN_OF_MOVE;
        // Before it is asked who should have seen it, which takes most of the time and makes it no more probable.
        if born.votes.len() + taken.len() < model.settings.min_votes || is_in_vain(&born) {
            return None;
        }
        let mut born = born.with_looks(model, lookout).filter(|born| !is_in_vain(born))?;
        let mut birth = Vec::new();
        let mut change = born.energy;
        for (vote, _) in taken {
            let other = self.owner[vote as usize] as usize;
            if birth.iter().any(|(i, _): &(usize, Option<Object>)| *i == other) {
                continue;
            }
            let mut votes = born.votes.clone();
            votes.push(vote);
            votes.sort_unstable();
            let Some(more) = object(model, lookout, votes, born.fit.point) else { continue };
            let (left, lost) = self.without(other, vote);
            if more.energy - born.energy + lost < -LEAST_GAIN_OF_MOVE {
                change += more.energy - born.energy + lost;
                born = more;
                birth.push((other, left));
            }
        }
        if birth.is_empty() {
            change -= 2.0 * ln_terms(model, self.sure, &born);
        }
        let is_one = born.votes.len() >= model.settings.min_votes && born.energy < 0.0;
        (is_one && change < -LEAST_GAIN_OF_MOVE).then_some(Birth { change, born, others: birth })
    }

    /// The votes of other objects that one explains better than clutter does, from images that show nothing else of it, with what each gains; the best first.
    fn takes(&self, born: &Object) -> Vec<(u32, f64)> {
        let model = self.model;
        let image = |ray: u32| model.scene.image_of(ray);
        let images: Vec<u32> = born.votes.iter().map(|&ray| image(ray)).collect();
        let may_be = |said| model.confusions.may_be(born.class, said);
        let range_m = model.reach_m();
        let hits = self.of_few.hits_of_any(&born.places(model), &may_be, range_m);
        let mut takes: Vec<(u32, f64)> = hits
            .into_iter()
            .filter(|hit| !images.contains(&hit.image))
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
        let is_enough = votes.len() >= self.model.settings.min_votes;
        let left = is_enough.then(|| object(self.model, self.lookout, votes, old.fit.point)).flatten();
        let left = left.filter(|left| left.energy < 0.0);
        let energy = left.as_ref().map_or(0.0, |left| left.energy);
        (left, energy - old.energy)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::robust::model::heights::Heights;
    use crate::street;

    #[test]
    fn what_takes_no_vote_is_born_only_where_an_object_of_few_votes_would_be() -> Result<(), Halt> {
        let scene = street::street(20, 1.0, &[Vector3::new(40.0, 4.0, 3.0)], &[[0.4, -0.3], [-0.2, 0.5], [0.1, 0.2]]);
        let mut model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
        model.classes[0].ln_births_per_m2 = -2.0 * street::VIABILITY.max_range_m.ln();
        model.classes[0].heights = Heights::learn(&[3.0; 60], &[0.1; 60], street::VIABILITY.max_range_m);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        for (ln_odds, is_born) in [(0.0, true), (-1e3, false)] {
            model.classes[0].ln_odds_of_few.fill(ln_odds);
            let (born, any) = regrow(&model, &lookout, &scene.usable_rays(), Vec::new(), &Progress::default())?;
            assert_eq!((any, born.len()), (is_born, usize::from(is_born)));
        }
        Ok(())
    }

    #[test]
    fn objects_of_many_visits_lose_no_votes() {
        let at = Vector3::new(30.0, 4.0, 3.0);
        let drive = || street::street(5, 2.0, &[at], &[[0.4, -0.3], [-0.2, 0.5], [0.1, 0.2]]);
        for (drives, is_open) in [(MOST_VISITS, true), (MOST_VISITS + 1, false)] {
            let scene = street::joined((0..drives).map(|_| drive()).collect());
            let model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
            let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
            let one = object(&model, &lookout, scene.usable_rays(), at);
            let open = open_to_others(&model, &one.into_iter().collect::<Vec<Object>>());
            assert_eq!(open, if is_open { scene.usable_rays() } else { Vec::new() });
        }
    }
}
