//! Confusions: the classes that a detector reports for objects of a class, learned from the map.
//!
//! They are `share_c(class)` of equation (4) of `docs/method.md`. A detector gives an object one box. Boxes of another class belong
//! to an object if they lie in its gate more often in images without a vote of its own class than in images with one. What stands
//! beside the object is there in both.

use std::collections::BTreeMap;

use super::assign::places_of;
use super::energy::Object;
use super::index::RayIndex;
use super::learn::is_sure;
use super::looks::Lookout;
use super::model::Model;

/// Of the detections of objects of each class, the shares that are said to be of other classes: few of all pairs of classes.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Confusions {
    /// By class of the object: said class, ascending, with its share.
    shares: Vec<Vec<(u32, f64)>>,
    /// Logarithm of what is left of each class: said to be what it is.
    ln_right: Vec<f64>,
    is_any: bool,
}

/// What objects of one class tell, each of which counts as one: neighbors stay where they are from image to image.
#[derive(Default, Clone)]
struct Tally {
    objects: f64,
    /// Votes of all.
    votes: f64,
    /// By said class: boxes in place of votes, beyond those that stand beside it; and their squares, object by object.
    instead: BTreeMap<u32, (f64, f64)>,
    /// The same of all classes together.
    of_any: (f64, f64),
}

impl Confusions {
    /// From the said classes of each class and their shares; those of classes beyond are what they are said to be.
    #[must_use]
    pub fn of_shares(mut shares: Vec<Vec<(u32, f64)>>) -> Self {
        for (class, row) in (0..).zip(&mut shares) {
            row.retain(|&(said, share)| said != class && share > 0.0);
            row.sort_unstable_by_key(|&(said, _)| said);
            row.dedup_by_key(|&mut (said, _)| said);
        }
        let right = |row: &Vec<(u32, f64)>| 1.0 - row.iter().map(|(_, share)| share).sum::<f64>();
        let ln_right = shares.iter().map(|row| right(row).max(f64::MIN_POSITIVE).ln()).collect();
        let is_any = shares.iter().any(|row| !row.is_empty());
        Self { shares, ln_right, is_any }
    }

    /// What [`of_shares`](Self::of_shares) took.
    #[must_use]
    pub fn shares(&self) -> &[Vec<(u32, f64)>] {
        &self.shares
    }

    /// Whether any class is taken for another one.
    #[must_use]
    pub fn is_any(&self) -> bool {
        self.is_any
    }

    /// Logarithm of the share of the detections of an object of a class that are said to be of another one.
    #[inline]
    #[must_use]
    pub fn ln_share(&self, class: u32, said: u32) -> f64 {
        if class == said {
            return self.ln_right.get(class as usize).copied().unwrap_or(0.0);
        }
        let row = self.shares.get(class as usize).map_or(&[][..], Vec::as_slice);
        row.binary_search_by_key(&said, |&(said, _)| said).map_or(f64::NEG_INFINITY, |place| row[place].1.ln())
    }

    /// Whether an object of a class is ever taken for one of another.
    #[inline]
    #[must_use]
    pub fn may_be(&self, class: u32, said: u32) -> bool {
        class == said || (self.is_any && self.ln_share(class, said) > f64::NEG_INFINITY)
    }

    /// The class of an object that makes what it is said to be most probable.
    #[must_use]
    pub fn likeliest(&self, said: impl Iterator<Item = u32>) -> Option<u32> {
        let mut said = said;
        let first = said.next()?;
        if !self.is_any {
            return Some(first);
        }
        let mut all: Vec<u32> = std::iter::once(first).chain(said).collect();
        all.sort_unstable();
        let counts: Vec<(u32, f64)> = all.chunk_by(|a, b| a == b).map(|same| (same[0], same.len() as f64)).collect();
        let ln_likelihood =
            |class: u32| -> f64 { counts.iter().map(|&(said, count)| count * self.ln_share(class, said)).sum() };
        // An object is at times said to be what it is. Of what no class explains, most are right.
        let likelier = |a: &(u32, f64), b: &(u32, f64)| {
            ln_likelihood(a.0).total_cmp(&ln_likelihood(b.0)).then(a.1.total_cmp(&b.1)).then(b.0.cmp(&a.0))
        };
        counts.iter().copied().max_by(likelier).map(|(class, _)| class)
    }

    /// Learn them from a map: those that are more than chance by as many standard deviations as a gate has. Of classes of so few objects that
    /// nothing could be, as many detections are confused as of all classes together.
    #[must_use]
    pub fn learn(model: &Model<'_>, lookout: &Lookout, index: &RayIndex<'_>, objects: &[Object]) -> Self {
        let sigmas = model.settings.gate_sigmas;
        let mut tallies: Vec<Tally> = vec![Tally::default(); model.classes.len()];
        for object in objects.iter().filter(|object| is_sure(object)) {
            tallies[object.class as usize].count(model, lookout, index, object);
        }
        let votes: f64 = tallies.iter().map(|tally| tally.votes).sum();
        let instead: f64 = tallies.iter().map(|tally| tally.of_any.0).sum();
        let squares: f64 = tallies.iter().map(|tally| tally.of_any.1).sum();
        let pooled = if is_more(instead, squares, sigmas) { instead / (votes + instead) } else { 0.0 };
        let seen: Vec<(u32, f64)> =
            (0..).zip(&tallies).map(|(class, tally)| (class, tally.votes)).filter(|(_, votes)| *votes > 0.0).collect();
        let of_class = |tally: &Tally| -> Vec<(u32, f64)> {
            if tally.objects >= sigmas * sigmas || !(tally.objects > 0.0 && pooled > 0.0) {
                return tally.shares(sigmas);
            }
            let others = votes - tally.votes;
            seen.iter()
                .map(|&(said, of_said)| (said, pooled * of_said / others))
                .filter(|row| row.1.is_finite())
                .collect()
        };
        Self::of_shares(tallies.iter().map(of_class).collect())
    }
}

/// Whether a sum, of which the sum of squares is given as well, is more than chance.
fn is_more(sum: f64, squares: f64, sigmas: f64) -> bool {
    sum > sigmas * squares.sqrt()
}

impl Tally {
    fn count(&mut self, model: &Model<'_>, lookout: &Lookout, index: &RayIndex<'_>, object: &Object) {
        let scene = model.scene;
        let image = |ray: u32| scene.rays.image[ray as usize];
        let is_own = |ray: &&u32| scene.rays.class[**ray as usize] == object.class;
        let voting: Vec<u32> = object.votes.iter().filter(is_own).map(|&ray| image(ray)).collect();
        let votes = voting.len() as f64;
        let missing = f64::from(lookout.expected(scene, &object.fit.point, &object.votes)) - votes;
        let reach_m = model.classes[object.class as usize].farthest_m;
        let hits = index.hits_of_any(&places_of(model, object), &|said| said != object.class, reach_m);
        let mut said: Vec<(u32, u32)> =
            hits.iter().map(|hit| (scene.rays.class[hit.ray as usize], hit.image)).collect();
        said.sort_unstable();
        said.dedup();
        let instead = |of_class: &[(u32, u32)]| {
            let beside = of_class.iter().filter(|(_, image)| voting.binary_search(image).is_ok()).count() as f64;
            (of_class[0].0, of_class.len() as f64 - beside - beside * missing / votes)
        };
        let instead: Vec<(u32, f64)> = said.chunk_by(|a, b| a.0 == b.0).map(instead).collect();
        // What most boxes take for something else is something else.
        if instead.iter().any(|(_, instead)| *instead > votes) {
            return;
        }
        self.objects += 1.0;
        self.votes += votes;
        let any: f64 = instead.iter().map(|(_, instead)| instead).sum();
        self.of_any = (self.of_any.0 + any, self.of_any.1 + any * any);
        for (said, instead) in instead {
            let sums = self.instead.entry(said).or_default();
            *sums = (sums.0 + instead, sums.1 + instead * instead);
        }
    }

    /// The said classes of the objects of one, and their shares of its detections.
    fn shares(&self, sigmas: f64) -> Vec<(u32, f64)> {
        let more = self.instead.iter().filter(|(_, (instead, squares))| is_more(*instead, *squares, sigmas));
        let more: Vec<(u32, f64)> = more.map(|(&said, &(instead, _))| (said, instead)).collect();
        let all = self.votes + more.iter().map(|(_, more)| more).sum::<f64>();
        more.into_iter().map(|(said, more)| (said, more / all)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A third of what is of class 0 is said to be of class 1.
    fn confused() -> Confusions {
        Confusions::of_shares(vec![vec![(1, 1.0 / 3.0), (0, 0.5), (2, 0.0)], Vec::new()])
    }

    #[test]
    fn an_object_is_of_the_class_that_makes_what_it_is_said_to_be_most_probable() {
        assert_eq!(confused().likeliest([1, 0, 1].into_iter()), Some(0));
        assert_eq!(confused().likeliest([1, 1, 1].into_iter()), Some(1));
        assert_eq!(confused().likeliest([2, 0, 2].into_iter()), Some(2));
        assert_eq!(confused().likeliest(std::iter::empty()), None);
        assert_eq!(Confusions::default().likeliest([1, 0, 0].into_iter()), Some(1));
    }

    #[test]
    fn shares_are_those_that_are_stored() {
        let confused = confused();
        assert_eq!(confused.shares(), [vec![(1, 1.0 / 3.0)], Vec::new()]);
        assert!(confused.is_any() && confused.may_be(0, 1) && !confused.may_be(1, 0) && confused.may_be(1, 1));
        assert!((confused.ln_share(0, 0) - (2.0_f64 / 3.0).ln()).abs() < 1e-12);
        assert!(confused.ln_share(9, 9).abs() < 1e-300 && !confused.may_be(9, 0));
        assert_eq!(Confusions::of_shares(confused.shares().to_vec()), confused);
        assert!(!Confusions::default().is_any() && Confusions::default().ln_share(1, 1).abs() < 1e-300);
    }
}
