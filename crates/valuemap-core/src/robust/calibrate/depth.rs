//! How deep to search: whether all moves change many objects of a sample.

use rustc_hash::{FxHashMap, FxHashSet};

use super::{CLASS_RAYS, WIDE};
use crate::progress::{Halt, Progress};
use crate::robust::energy::{Object, Placed, placed};
use crate::robust::model::{CHANCE_SIGMAS, Model};
use crate::robust::scene::sample;
use crate::robust::search::{Depth, search};

/// All moves take some ten times as long: they pay if they change more than one object in ten of those that are kept, by more than chance.
const LEAST_CHANGE: f64 = 0.1;
/// Below so many expected changes the normal distribution says nothing of their number. Five is the usual rule for binomial counts.
const LEAST_EXPECTED: f64 = 5.0;
/// It is asked of so many parts of the places that classes are learned from, one after the other, until they tell: a part has some twenty objects. Asked of one
/// and then of all, it took five times as long in a large city (`docs/notes/method.md`).
const PARTS_OF_PLACES: usize = 5;

/// Whether all moves change many objects of the places that classes are learned from, of which the map is known.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn all_moves_pay(model: &mut Model<'_>, objects: &[Object], progress: &Progress) -> Result<bool, Halt> {
    let (mut change, mut asked) = (Change::default(), Vec::new());
    for part in 1..=PARTS_OF_PLACES {
        let more = sample::places(
            model.scene,
            CLASS_RAYS * part / PARTS_OF_PLACES,
            WIDE * model.settings.viability.max_range_m,
        );
        let rays: Vec<u32> = more.iter().copied().filter(|ray| asked.binary_search(ray).is_err()).collect();
        change.add(changed(model, &rays, objects, progress)?);
        if let Some(is_much) = change.is_much() {
            return Ok(is_much);
        }
        asked = more;
    }
    Ok(false)
}

/// How many objects of some places (their rays, ascending) all moves change. Rays of objects that have others as well stay out, and so do drives
/// where there are many.
fn changed(model: &mut Model<'_>, rays: &[u32], objects: &[Object], progress: &Progress) -> Result<Change, Halt> {
    let is_whole = |object: &&Object| object.votes.iter().all(|ray| rays.binary_search(ray).is_ok());
    let (whole, partly): (Vec<&Object>, Vec<&Object>) = objects.iter().partition(is_whole);
    let elsewhere: FxHashSet<u32> = partly.iter().flat_map(|object| &object.votes).copied().collect();
    let left = rays.iter().copied().filter(|ray| !elsewhere.contains(ray)).collect();
    let rays = sample::passes(model.scene, left, CLASS_RAYS);
    let votes_here =
        |object: &Object| object.votes.iter().copied().filter(|ray| rays.binary_search(ray).is_ok()).collect();
    let begun = whole.iter().map(|object| (votes_here(object), object.fit.point));
    let begun = begun.filter(|(votes, _): &Placed| votes.len() >= model.settings.min_votes).collect();
    let (once, _) = search(model, &rays, begun, Depth::Once, false, progress)?;
    let (deeper, _) = search(model, &rays, placed(&once), Depth::Deep, false, progress)?;
    Ok(Change::of(&once, &deeper, model.settings.min_existence))
}

/// How many objects of two maps of the same rays are in both.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Change {
    kept: usize,
    /// Of both maps together.
    objects: usize,
}

impl Change {
    /// An object is in both maps if most of its votes are most of those of one of the other map. What exists less probably than `min_existence` is in
    /// no map that a user sees, and does not count.
    fn of(some: &[Object], others: &[Object], min_existence: f64) -> Self {
        let shown = |objects: &[Object]| -> Vec<Vec<u32>> {
            let likely = objects.iter().filter(|object| object.existence() >= min_existence);
            likely.map(|object| object.votes.clone()).collect()
        };
        let (some, others) = (shown(some), shown(others));
        let owner: FxHashMap<u32, usize> =
            others.iter().enumerate().flat_map(|(i, votes)| votes.iter().map(move |&ray| (ray, i))).collect();
        let is_kept = |votes: &&Vec<u32>| {
            let mut of: Vec<usize> = votes.iter().filter_map(|ray| owner.get(ray).copied()).collect();
            of.sort_unstable();
            let is_most = |shared: &[usize]| 2 * shared.len() > votes.len().max(others[shared[0]].len());
            of.chunk_by(|a, b| a == b).any(is_most)
        };
        Self { kept: some.iter().filter(is_kept).count(), objects: some.len() + others.len() }
    }

    fn add(&mut self, other: Self) {
        self.kept += other.kept;
        self.objects += other.objects;
    }

    /// Whether many objects are not in both; nothing if that may be chance.
    fn is_much(self) -> Option<bool> {
        let count = self.objects as f64;
        if count * LEAST_CHANGE < LEAST_EXPECTED {
            return None;
        }
        let chance = (LEAST_CHANGE * (1.0 - LEAST_CHANGE) / count).sqrt();
        let more = 1.0 - 2.0 * self.kept as f64 / count - LEAST_CHANGE;
        (more.abs() > CHANCE_SIGMAS * chance).then_some(more > 0.0)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix3;

    use super::*;
    use crate::robust::energy::Fit;
    use crate::robust::energy::seen::Seen;

    fn with_votes(first: u32, count: u32) -> Object {
        let fit = Fit {
            point: nalgebra::Vector3::zeros(),
            covariance: Matrix3::identity(),
            energy: 0.0,
            chi2: Vec::new(),
            shown: Vec::new(),
        };
        let (ln_size, seen) = (f64::NAN, Seen::default());
        let votes = (first..first + count).collect();
        Object { class: 0, votes, fit, ln_size, seen, real: 1.0, energy: -100.0 }
    }

    #[test]
    fn all_moves_pay_if_they_change_more_than_one_object_in_ten_and_that_is_no_chance() {
        let some: Vec<Object> = (0..100).map(|i| with_votes(10 * i, 10)).collect();
        // Each of the first is two halves: none of them is what it was.
        let halved = |count: u32| -> Vec<Object> {
            (0..100)
                .flat_map(|i| {
                    let parts = if i < count { vec![(0, 5), (5, 5)] } else { vec![(0, 10)] };
                    parts.into_iter().map(move |(first, votes)| with_votes(10 * i + first, votes))
                })
                .collect()
        };
        let changed = |some: &[Object], others: &[Object]| Change::of(some, others, 0.55).is_much();
        assert_eq!(changed(&some, &some), Some(false));
        // 24 of 208 are 11.5 %, with a standard deviation of 2.1 %.
        assert_eq!(changed(&some, &halved(8)), None);
        assert!(changed(&some, &halved(12)) == Some(true) && changed(&halved(12), &some) == Some(true));
        // 27 of 209 are 12.9 %, with a standard deviation of 2.1 %: one part does not tell, three do.
        let part = Change::of(&some, &halved(9), 0.55);
        let mut parts = Change::default();
        (0..3).for_each(|_| parts.add(part));
        assert_eq!((part.is_much(), parts.is_much()), (None, Some(true)));
        // Where hardly anything is found, it is no change that hardly anything is in both.
        assert_eq!((changed(&[], &[]), changed(&some[..1], &some[1..20])), (None, None));
        // What only all moves find, and is in no map: a third of all.
        let ghosts = (0..50).map(|i| Object { real: 0.4, ..with_votes(10_000 + 10 * i, 10) });
        assert_eq!(changed(&some, &some.iter().cloned().chain(ghosts).collect::<Vec<_>>()), Some(false));
    }
}
