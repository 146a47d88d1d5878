//! How many objects of few votes there can be, by how many there are of more.
//!
//! Where objects have ten votes each, hardly any has one. The numbers of objects with 1, 2, 3, ... votes are taken to be log-concave, as those of a
//! Poisson distribution are and of most mixtures of it: `N1 N3 <= N2²` and `N2 N4 <= N3²`; where too few have three or four votes to tell, they are
//! those of a negative binomial distribution, by the method of moments. What the energies of objects of few votes add up to is brought down to that.

use super::energy::Object;
use super::model::{Model, ln_gamma, mean_and_sd};

/// The ratio of two numbers as large as this is known to a half.
const ENOUGH: f64 = 10.0;
/// Rounds of bisection: odds are right to a millionth.
const ROUNDS: usize = 60;
/// No odds are brought down by more than this factor, in logarithms.
const MOST: f64 = 50.0;
/// The largest k: a Poisson distribution, for all that is known.
const LEAST_DISPERSION: f64 = 1e3;
/// Objects of one vote, of two, and of more that rays alone do not tell.
pub const FEW: usize = 3;
/// Objects of so many votes are there without those of few.
const LEAST_VOTES: usize = 3;
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
    let usual = |n: usize| negative_binomial(&votes, n);
    let bound = |here: f64, next: f64, n: usize| {
        if here.min(next) < ENOUGH { usual(n) } else { (here * here / next).max(usual(n)) }
    };
    let most = few.iter().map(|object| object.votes.len()).max().unwrap_or(0);
    let more = |ln_odds: f64| (LEAST_VOTES..=most).map(|votes| expected(votes, ln_odds)).sum::<f64>();
    let of_more = at_most((LEAST_VOTES..=MOST_VOTES).map(usual).sum(), more);
    let (three, four) = (count(3), count(4));
    let of_two = at_most(bound(three, four, 2), |ln_odds| expected(2, ln_odds));
    let of_one = at_most(bound(expected(2, of_two), three, 1), |ln_odds| expected(1, ln_odds));
    [of_one, of_two, of_more]
}

/// How many objects of `n` votes there are if the others, of three votes or more, are of a negative binomial distribution.
fn negative_binomial(votes: &[f64], n: usize) -> f64 {
    let (mean, sd) = mean_and_sd(votes);
    if votes.is_empty() {
        return 0.0;
    }
    // Poisson distributions whose means differ: their variance is the mean and mean² / k.
    let k = mean * mean / (sd * sd - mean).max(mean * mean / LEAST_DISPERSION);
    let share = |n: usize| {
        let n = n as f64;
        let ln_choose = ln_gamma(n + k) - ln_gamma(k) - ln_gamma(n + 1.0);
        (ln_choose + k * (k / (k + mean)).ln() + n * (mean / (k + mean)).ln()).exp()
    };
    let few: f64 = (0..LEAST_VOTES).map(share).sum();
    votes.len() as f64 * share(n) / (1.0 - few).max(f64::MIN_POSITIVE)
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

/// The largest number not above 0 with which an ascending function is not above a bound.
fn at_most(bound: f64, value: impl Fn(f64) -> f64) -> f64 {
    if value(0.0) <= bound {
        return 0.0;
    }
    let (mut low, mut high) = (-MOST, 0.0);
    for _ in 0..ROUNDS {
        let middle = 0.5 * (low + high);
        if value(middle) <= bound { low = middle } else { high = middle }
    }
    low
}

#[cfg(test)]
mod tests {
    use super::super::energy::anywhere;
    use super::super::seen::Seen;
    use super::*;

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
    fn numbers_of_objects_by_votes_are_log_concave() {
        let many: Vec<Object> = [(3, 40), (4, 60), (5, 60)]
            .into_iter()
            .flat_map(|(votes, count)| (0..count).map(move |_| of_votes(votes, -60.0)))
            .collect();
        let few: Vec<Object> = (0..80).map(|i| of_votes(1 + i % 2, -6.0)).collect();
        let odds = ln_odds_of_few(&many.iter().collect::<Vec<_>>(), &few.iter().collect::<Vec<_>>());
        let of = |votes: usize| few.iter().filter(|object| object.votes.len() == votes).cloned().collect::<Vec<_>>();
        let (one, two) = (expected(&of(1), odds[0]), expected(&of(2), odds[1]));
        // The larger of both bounds holds: that of log-concave numbers is the least that there may be.
        assert!((40.0 * 40.0 / 60.0 - 0.01..32.0).contains(&two), "{two}");
        assert!((two * two / 40.0 - 0.01..two).contains(&one), "{one}");
    }
}
