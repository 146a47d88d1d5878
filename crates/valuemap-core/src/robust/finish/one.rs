//! How many of some pairs of objects are one thing: where poses are off by more than was thought, most of those that may be are.

use crate::robust::model::FALSE_SHARE;

/// So many pairs more are thought to be two: among so many, one thing is false. Of few pairs, none is one of which that is not sure.
const TWO: f64 = 1.0 / FALSE_SHARE;
/// Steps of expectation and maximisation: as many more change no share by more than a hundredth.
const STEPS: usize = 40;

/// The share that is one, by expectation and maximisation, of pairs of which what is seen is so much likelier if they are one (`odds`) and of some that are
/// `two` for certain.
#[must_use]
pub fn share_of_one(odds: &[f64], two: usize) -> f64 {
    let mut share = 0.5;
    for _ in 0..STEPS {
        let one: f64 = odds.iter().map(|&odds| probability_of_one(share, odds)).sum();
        share = one / ((odds.len() + two) as f64 + TWO);
    }
    share
}

/// The probability that a pair is one.
#[must_use]
pub fn probability_of_one(share: f64, odds: f64) -> f64 {
    share / (share + (1.0 - share) / odds)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn most_are_one_where_hardly_any_is_two_for_certain() {
        let share = share_of_one(&[10.0; 50], 5);
        assert!(share > 0.6 && probability_of_one(share, 10.0) > 0.9, "{share}");
    }

    #[test]
    fn none_is_one_where_as_many_are_two_as_what_is_seen_makes_probable() {
        let share = share_of_one(&[3.0; 20], 40);
        assert!(share < 0.01, "{share}");
    }

    #[test]
    fn of_few_only_those_are_one_of_which_that_is_sure() {
        let share = share_of_one(&[3.0; 3], 0);
        assert!(probability_of_one(share, 3.0) < 0.01, "{share}");
        let share = share_of_one(&[1e4, 3.0, 3.0], 0);
        assert!(probability_of_one(share, 1e4) > 0.99 && probability_of_one(share, 3.0) < 0.3, "{share}");
    }

    #[test]
    fn what_is_certain_stays_a_number() {
        assert!(share_of_one(&[f64::INFINITY; 3], 0) < 1.0 && share_of_one(&[], 0) < 1.0);
        assert!((probability_of_one(share_of_one(&[f64::INFINITY], 0), f64::INFINITY) - 1.0).abs() < 1e-9);
    }
}
