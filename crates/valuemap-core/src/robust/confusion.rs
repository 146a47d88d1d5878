//! Confusions: what a detector takes an object of a class for, learned from the map.
//!
//! A detector gives an object one box. Where boxes of another class lie in an object's gate more often in images in which its own class missed it than in
//! those in which it did not, they are its own. What stands beside it is there in both.

use super::assign::places_of;
use super::energy::Object;
use super::index::RayIndex;
use super::learn::MIN_VOTES;
use super::looks::Lookout;
use super::model::Model;

/// The shares of the detections of objects of each class that are said to be of each class.
#[derive(Debug, Clone, PartialEq)]
pub struct Confusions {
    /// By class of the object and said class; of what is said to be what it is, 0.
    shares: Vec<Vec<f64>>,
    /// Logarithms, by class of the object and said class; minus infinity where it never is.
    ln_share: Vec<f64>,
    is_any: bool,
}

/// What objects of one class tell, each of which counts as one: neighbors stay where they are from image to image.
struct Tally {
    objects: f64,
    /// Votes of all.
    votes: f64,
    /// By said class: boxes in place of votes, beyond those that stand beside it; and their squares, object by object.
    instead: Vec<f64>,
    squares: Vec<f64>,
    /// The same of all classes together.
    of_any: (f64, f64),
}

impl Confusions {
    /// No class is taken for another one.
    #[must_use]
    pub fn none(classes: usize) -> Self {
        Self::of_shares(&vec![Vec::new(); classes])
    }

    /// From the shares of each class, by class of the object and said class; what is left of each is said to be what it is. Shares that are not
    /// there are 0.
    #[must_use]
    pub fn of_shares(shares: &[Vec<f64>]) -> Self {
        let classes = shares.len();
        let mut ln_share = vec![f64::NEG_INFINITY; classes * classes];
        let of = |class: usize, said: usize| {
            if class == said { 0.0 } else { shares[class].get(said).copied().unwrap_or(0.0) }
        };
        let shares: Vec<Vec<f64>> =
            (0..classes).map(|class| (0..classes).map(|said| of(class, said)).collect()).collect();
        for (class, of_class) in shares.iter().enumerate() {
            for (said, &share) in of_class.iter().enumerate().filter(|(_, share)| **share > 0.0) {
                ln_share[class * classes + said] = share.ln();
            }
            let right = 1.0 - of_class.iter().sum::<f64>();
            ln_share[class * classes + class] = right.max(f64::MIN_POSITIVE).ln();
        }
        let is_any = shares.iter().flatten().any(|share| *share > 0.0);
        Self { shares, ln_share, is_any }
    }

    /// What [`of_shares`](Self::of_shares) took.
    #[must_use]
    pub fn shares(&self) -> &[Vec<f64>] {
        &self.shares
    }

    /// The same among the first of so many classes: others are what they are said to be.
    #[must_use]
    pub fn among(&self, classes: usize) -> Self {
        let mut shares = self.shares.clone();
        shares.resize(classes, Vec::new());
        Self::of_shares(&shares)
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
        self.ln_share[class as usize * self.shares.len() + said as usize]
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
        let mut counts = vec![0.0; self.shares.len()];
        std::iter::once(first).chain(said).for_each(|said| counts[said as usize] += 1.0);
        let ln_likelihood = |class: u32| -> f64 {
            let said = (0..).zip(&counts).filter(|(_, count)| **count > 0.0);
            said.map(|(said, count)| count * self.ln_share(class, said)).sum()
        };
        // Of what no class explains, most are right.
        let by_likelihood = |a: &u32, b: &u32| {
            let [of_a, of_b] = [*a, *b].map(|class| (ln_likelihood(class), counts[class as usize]));
            of_a.0.total_cmp(&of_b.0).then(of_a.1.total_cmp(&of_b.1)).then(b.cmp(a))
        };
        (0..self.shares.len() as u32).max_by(by_likelihood)
    }

    /// Learn them from a map: those that are more than chance by as many standard deviations as a gate has. Of classes of so few objects that
    /// nothing could be, as many detections are confused as of all classes together.
    #[must_use]
    pub fn learn(model: &Model<'_>, lookout: &Lookout, index: &RayIndex<'_>, objects: &[Object]) -> Self {
        let sigmas = model.settings.gate_sigmas;
        let classes = model.classes.len();
        let mut tallies: Vec<Tally> = (0..classes).map(|_| Tally::new(classes)).collect();
        let is_sure = |object: &&Object| object.votes.len() >= MIN_VOTES && object.real > 0.5;
        for object in objects.iter().filter(is_sure) {
            tallies[object.class as usize].count(model, lookout, index, object);
        }
        let votes: f64 = tallies.iter().map(|tally| tally.votes).sum();
        let instead: f64 = tallies.iter().map(|tally| tally.of_any.0).sum();
        let squares: f64 = tallies.iter().map(|tally| tally.of_any.1).sum();
        let pooled = if is_more(instead, squares, sigmas) { instead / (votes + instead) } else { 0.0 };
        let of_class = |(class, tally): (usize, &Tally)| {
            if tally.objects >= sigmas * sigmas {
                return tally.shares(sigmas);
            }
            let others: f64 = votes - tally.votes;
            let share =
                |(said, of_said): (usize, &Tally)| if said == class { 0.0 } else { pooled * of_said.votes / others };
            tallies.iter().enumerate().map(share).map(|share| if share.is_finite() { share } else { 0.0 }).collect()
        };
        Self::of_shares(&tallies.iter().enumerate().map(of_class).collect::<Vec<_>>())
    }
}

/// Whether a sum, of which the sum of squares is given as well, is more than chance.
fn is_more(sum: f64, squares: f64, sigmas: f64) -> bool {
    sum > sigmas * squares.sqrt()
}

impl Tally {
    fn new(classes: usize) -> Self {
        Self { objects: 0.0, votes: 0.0, instead: vec![0.0; classes], squares: vec![0.0; classes], of_any: (0.0, 0.0) }
    }

    fn count(&mut self, model: &Model<'_>, lookout: &Lookout, index: &RayIndex<'_>, object: &Object) {
        let scene = model.scene;
        let image = |ray: u32| scene.rays.image[ray as usize];
        let is_own = |ray: &&u32| scene.rays.class[**ray as usize] == object.class;
        let voting: Vec<u32> = object.votes.iter().filter(is_own).map(|&ray| image(ray)).collect();
        let votes = voting.len() as f64;
        let missing = f64::from(lookout.expected(scene, &object.fit.point, &object.votes)) - votes;
        let reach_m = model.classes[object.class as usize].farthest_m;
        let hits = index.hits_of_any(&places_of(object), &|said| said != object.class, reach_m);
        let mut said: Vec<(u32, u32)> =
            hits.iter().map(|hit| (scene.rays.class[hit.ray as usize], hit.image)).collect();
        said.sort_unstable();
        said.dedup();
        let instead = |of_class: &[(u32, u32)]| {
            let beside = of_class.iter().filter(|(_, image)| voting.binary_search(image).is_ok()).count() as f64;
            (of_class[0].0 as usize, of_class.len() as f64 - beside - beside * missing / votes)
        };
        let instead: Vec<(usize, f64)> = said.chunk_by(|a, b| a.0 == b.0).map(instead).collect();
        // What most boxes take for something else is something else.
        if instead.iter().any(|(_, instead)| *instead > votes) {
            return;
        }
        self.objects += 1.0;
        self.votes += votes;
        let any: f64 = instead.iter().map(|(_, instead)| instead).sum();
        self.of_any = (self.of_any.0 + any, self.of_any.1 + any * any);
        for (said, instead) in instead {
            self.instead[said] += instead;
            self.squares[said] += instead * instead;
        }
    }

    /// The share of each class among the detections of the objects of one.
    fn shares(&self, sigmas: f64) -> Vec<f64> {
        let more = |(&instead, &squares): (&f64, &f64)| if is_more(instead, squares, sigmas) { instead } else { 0.0 };
        let more: Vec<f64> = self.instead.iter().zip(&self.squares).map(more).collect();
        let all = self.votes + more.iter().sum::<f64>();
        more.into_iter().map(|more| more / all.max(1.0)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A third of what is of class 0 is said to be of class 1.
    fn confused() -> Confusions {
        Confusions::of_shares(&[vec![0.0, 1.0 / 3.0], Vec::new(), Vec::new()])
    }

    #[test]
    fn an_object_is_of_the_class_that_makes_what_it_is_said_to_be_most_probable() {
        assert_eq!(confused().likeliest([1, 0, 1].into_iter()), Some(0));
        assert_eq!(confused().likeliest([1, 1, 1].into_iter()), Some(1));
        assert_eq!(confused().likeliest([2, 0, 2].into_iter()), Some(2));
        assert_eq!(confused().likeliest(std::iter::empty()), None);
        assert_eq!(Confusions::none(3).likeliest([1, 0, 0].into_iter()), Some(1));
    }

    #[test]
    fn shares_are_those_that_are_stored() {
        let confused = confused();
        assert!(confused.is_any() && confused.may_be(0, 1) && !confused.may_be(1, 0) && confused.may_be(1, 1));
        assert!((confused.ln_share(0, 0) - (2.0_f64 / 3.0).ln()).abs() < 1e-12);
        assert_eq!(Confusions::of_shares(confused.shares()), confused);
        let more = confused.among(4);
        assert!(more.may_be(0, 1) && more.ln_share(3, 3).abs() < 1e-12 && !more.may_be(3, 0));
        assert!(!Confusions::none(2).is_any() && Confusions::none(2).ln_share(1, 1).abs() < 1e-300);
    }
}
