//! How many objects of few votes there can be, by how many there are of more: equation (8) of `docs/method.md`.
//!
//! The numbers N1, N2, N3, ... of objects with 1, 2, 3, ... votes are taken to be log-concave, as those of a Poisson distribution and of most mixtures of
//! it: `N1 N3 <= N2²` and `N2 N4 <= N3²`. Where too few have three or four votes to tell, they are those of the likeliest negative binomial
//! distribution. The odds of objects of few votes are lowered until their expected number is within these bounds.

use crate::robust::energy::{LEAST_VOTES, Object};
use crate::robust::model::steps::LEAST_DETECTIONS;
use crate::robust::model::{FEW, Model, ln_gamma, mean_and_sd};

/// Rounds of bisection: odds are right to a millionth.
const ROUNDS: usize = 60;
/// No odds are changed by more than this factor, in logarithms. It stays finite: what is surer than that stays, whatever the numbers of others say.
pub(crate) const MOST: f64 = 50.0;
/// The largest k: a Poisson distribution, for all that is known.
const LEAST_DISPERSION: f64 = 1e3;
/// Votes of an object, on average, are no fewer: objects that nobody sees are not counted.
const LEAST_MEAN: f64 = 1.0;
/// Objects of little parallax have hardly more votes.
const MOST_VOTES: usize = 6;

/// What is to be added to the logarithms of the odds of objects of one vote, of two, and of more, so that there are no more than the numbers of `objects` of
/// more allow.
#[must_use]
pub fn ln_odds_of_few(objects: &[&Object], few: &[&Object]) -> [f64; FEW] {
    let expected = |votes: usize, ln_odds: f64| -> f64 {
        few.iter()
            .filter(|object| object.votes.len() == votes)
            .map(|object| object.real / (1.0 + (0.5 * object.energy - ln_odds).exp()))
            .sum()
    };
    let count = |votes: usize| {
        objects.iter().filter(|object| object.votes.len() == votes).count() as f64 + expected(votes, 0.0)
    };
    let votes: Vec<f64> = objects
        .iter()
        .map(|object| object.votes.len())
        .filter(|&votes| votes >= LEAST_VOTES)
        .map(|n| n as f64)
        .collect();
    let counts = Counts::of(&votes);
    let usual = |n: usize| counts.at(n);
    let bound = |here: f64, next: f64, n: usize| {
        if here.min(next) < LEAST_DETECTIONS { usual(n) } else { here * here / next }
    };
    let most = few.iter().map(|object| object.votes.len()).max().unwrap_or(0);
    let more = |ln_odds: f64| (LEAST_VOTES..=most).map(|votes| expected(votes, ln_odds)).sum::<f64>();
    let of_more = at_most((LEAST_VOTES..=MOST_VOTES).map(usual).sum(), 0.0, more);
    let (three, four) = (count(3), count(4));
    // Where two votes are enough, some of two are objects of their own.
    let two = objects.iter().filter(|object| object.votes.len() == 2).count() as f64;
    let of_two = at_most((bound(three, four, 2) - two).max(0.0), 0.0, |ln_odds| expected(2, ln_odds));
    let of_one = at_most(bound(two + expected(2, of_two), three, 1), 0.0, |ln_odds| expected(1, ln_odds));
    [of_one, of_two, of_more]
}

/// How many objects of each number of votes there are, by those of three votes or more.
struct Counts {
    /// Of three votes or more.
    objects: f64,
    mean: f64,
    /// A Poisson distribution whose mean differs from object to object has the variance mean + mean² / k.
    k: f64,
}

impl Counts {
    /// The negative binomial distribution that makes some votes likeliest, of those from [`LEAST_VOTES`] on: what has fewer is missing among them. With k of
    /// at least one its numbers are log-concave.
    fn of(votes: &[f64]) -> Self {
        let objects = votes.len() as f64;
        let mean = mean_and_sd(votes).0;
        let with = |ln_k: f64| Self { objects, ..Self::with_mean(mean, ln_k.exp()) };
        let misfit = |ln_k: f64| -> f64 {
            let counts = with(ln_k);
            let ln_more = counts.share_of_more().ln();
            votes.iter().map(|&n| ln_more - counts.ln_share(n)).sum()
        };
        with(least_of(misfit, 0.0, LEAST_DISPERSION.ln()))
    }

    /// That with a mean of those from [`LEAST_VOTES`] on: it grows with the mean of all.
    fn with_mean(mean_of_more: f64, k: f64) -> Self {
        let with = |mean: f64| Self { objects: 0.0, mean, k };
        let (mut low, mut high) = (LEAST_MEAN, mean_of_more.max(LEAST_MEAN));
        for _ in 0..ROUNDS {
            let middle = 0.5 * (low + high);
            if with(middle).mean_of_more() <= mean_of_more { low = middle } else { high = middle }
        }
        with(low)
    }

    fn ln_share(&self, n: f64) -> f64 {
        let Self { mean, k, .. } = *self;
        let ln_choose = ln_gamma(n + k) - ln_gamma(k) - ln_gamma(n + 1.0);
        ln_choose + k * (k / (k + mean)).ln() + n * (mean / (k + mean)).ln()
    }

    fn few(&self) -> impl Iterator<Item = (f64, f64)> {
        (0..LEAST_VOTES).map(|n| (n as f64, self.ln_share(n as f64).exp()))
    }

    fn share_of_more(&self) -> f64 {
        1.0 - self.few().map(|(_, share)| share).sum::<f64>()
    }

    fn mean_of_more(&self) -> f64 {
        (self.mean - self.few().map(|(n, share)| n * share).sum::<f64>()) / self.share_of_more()
    }

    /// How many objects have `n` votes.
    fn at(&self, n: usize) -> f64 {
        if self.objects == 0.0 { 0.0 } else { self.objects * self.ln_share(n as f64).exp() / self.share_of_more() }
    }
}

/// Where a function of one minimum between two places is least.
fn least_of(value: impl Fn(f64) -> f64, mut low: f64, mut high: f64) -> f64 {
    for _ in 0..ROUNDS {
        let third = (high - low) / 3.0;
        if value(low + third) <= value(high - third) { high -= third } else { low += third }
    }
    0.5 * (low + high)
}

/// Learn it for all classes of a model, from the objects of a map and those of few votes beside it.
pub fn learn_counts(model: &mut Model<'_>, objects: &[Object], few: &[Object]) {
    model.pooled.ln_odds_of_few = ln_odds_of_few(&objects.iter().collect::<Vec<_>>(), &few.iter().collect::<Vec<_>>());
    for (class, learned) in (0..).zip(&mut model.classes) {
        learned.ln_odds_of_few = ln_odds_of_few(&of_class(objects, class), &of_class(few, class));
    }
}

fn of_class(objects: &[Object], class: u32) -> Vec<&Object> {
    objects.iter().filter(|object| object.class == class).collect()
}

/// The largest number not above `most`, nor more than [`MOST`] below 0, with which an ascending function is not above a bound.
pub(crate) fn at_most(bound: f64, most: f64, value: impl Fn(f64) -> f64) -> f64 {
    if value(most) <= bound {
        return most;
    }
    let (mut low, mut high) = (-MOST, most);
    for _ in 0..ROUNDS {
        let middle = 0.5 * (low + high);
        if value(middle) <= bound { low = middle } else { high = middle }
    }
    low
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robust::energy::anywhere;
    use crate::robust::energy::seen::Seen;

    fn of_votes(votes: usize, energy: f64) -> Object {
        anywhere(votes, Seen::default(), energy)
    }

    fn expected(few: &[Object], ln_odds: f64) -> f64 {
        few.iter().map(|object| 1.0 / (1.0 + (0.5 * object.energy - ln_odds).exp())).sum()
    }

    #[test]
    fn where_objects_have_many_votes_hardly_any_has_one() {
        let many: Vec<Object> = (0..60).map(|i| of_votes(20 + i % 20, -100.0)).collect();
        let few: Vec<Object> = (0..40).map(|_| of_votes(1, -6.0)).collect();
        let [of_one, ..] = ln_odds_of_few(&many.iter().collect::<Vec<_>>(), &few.iter().collect::<Vec<_>>());
        assert!(expected(&few, 0.0) > 35.0 && expected(&few, of_one) < 0.1);
    }

    #[test]
    fn where_few_objects_tell_those_of_fewer_votes_are_missing_among_them() {
        // Of fifty objects with two votes on average (Poisson), as many as usual have 3, 4 and 5; 13.5 have two and 13.5 have one.
        let numbers = [(3, 9), (4, 5), (5, 2)];
        let many = numbers.map(|(votes, count)| vec![of_votes(votes, -60.0); count]).concat();
        let few = [1, 2].map(|votes| vec![of_votes(votes, -6.0); 60]).concat();
        let odds = ln_odds_of_few(&many.iter().collect::<Vec<_>>(), &few.iter().collect::<Vec<_>>());
        let two = expected(&few[60..], odds[1]);
        let one = expected(&few[..60], odds[0]);
        assert!((10.0..25.0).contains(&two) && (10.0..25.0).contains(&one), "{two} {one}");
    }

    #[test]
    fn where_all_objects_have_three_votes_no_more_have_fewer_than_with_one_on_average() {
        let many = vec![of_votes(3, -60.0); 6];
        let few = vec![of_votes(1, -6.0); 200];
        let [of_one, ..] = ln_odds_of_few(&many.iter().collect::<Vec<_>>(), &few.iter().collect::<Vec<_>>());
        let one = expected(&few, of_one);
        assert!(one > 6.0 && one < 6.0 * 6.0, "{one}");
    }

    #[test]
    fn numbers_of_objects_by_votes_are_log_concave() {
        let many: Vec<Object> = [(3, 40), (4, 60), (5, 60)]
            .into_iter()
            .flat_map(|(votes, count)| (0..count).map(move |_| of_votes(votes, -60.0)))
            .collect();
        let few: Vec<Object> = (0..80).map(|i| of_votes(1 + i % 2, -6.0)).collect();
        let odds = ln_odds_of_few(&many.iter().collect::<Vec<_>>(), &few.iter().collect::<Vec<_>>());
        let of = |votes: usize| few.iter().filter(|object| object.votes.len() == votes).cloned().collect::<Vec<_>>();
        let (one, two) = (expected(&of(1), odds[0]), expected(&of(2), odds[1]));
        assert!((two - 40.0 * 40.0 / 60.0).abs() < 0.01, "{two}");
        assert!((one - two * two / 40.0).abs() < 0.01, "{one}");
    }

    #[test]
    fn where_two_votes_are_enough_some_objects_have_no_more() {
        let many: Vec<Object> = [(2, 40), (3, 40), (4, 60)]
            .into_iter()
            .flat_map(|(votes, count)| (0..count).map(move |_| of_votes(votes, -60.0)))
            .collect();
        let few = vec![of_votes(1, -6.0); 80];
        let odds = ln_odds_of_few(&many.iter().collect::<Vec<_>>(), &few.iter().collect::<Vec<_>>());
        let one = expected(&few, odds[0]);
        assert!((one - 40.0).abs() < 0.01, "{one}");
    }
}
