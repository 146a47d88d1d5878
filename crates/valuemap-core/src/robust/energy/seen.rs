//! The likelihood of the looks at an object, if it is real and if it is false: equation (5) of `docs/method.md`.
//!
//! The hit rate of a real object differs from side to side (logit-normal) and, around that, from pass to pass (beta-binomial); an odd pass may have any
//! rate. A false thing is there on one pass alone, or is seen less than a real object from everywhere, or is a ghost: rays that meet by chance, so that
//! hardly any look is a hit. Only the side with most hits decides, since from other sides a real object may be seen less as well.

use std::cmp::Ordering;
use std::f64::consts::LN_2;

use crate::robust::model::{ClassModel, FALSE_SHARE, Rates, ln_gamma};

/// Shares of hits that sides may have: about as finely as some dozen looks tell them apart.
const SHARES: usize = 12;

/// Looks of one pass at an object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Looks {
    /// Viewpoints that should have seen it.
    pub expected: f64,
    /// Viewpoints that did.
    pub hits: f64,
}

/// All looks at an object.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Seen {
    /// By sector, and there by pass.
    pub sectors: Vec<Vec<Looks>>,
    /// Logarithm of how probable it is that of all looks, and of the images of each, those are the hits that are.
    pub ln_which: f64,
}

/// Ghosts have less than this part of the usual hits. An object that is hardly seen has about half of them, and what is false for other reasons any part.
const GHOSTLY: f64 = 0.25;

/// The shares of hits that the sides of objects of a class may have.
pub(crate) struct Shares<'a> {
    class: &'a ClassModel,
    each: [Share; SHARES],
    /// Logarithm of the gamma function of the concentration.
    ln_gamma: f64,
}

/// One of them: its beta distribution over passes.
#[derive(Clone, Copy)]
struct Share {
    hit: f64,
    miss: f64,
    /// Logarithms of the gamma function of both.
    ln_gamma: (f64, f64),
    /// How probable it is that a side has it: as usual, where it is seen less, and that of a ghost.
    ln_usual: f64,
    ln_less: f64,
    ln_ghost: f64,
}

impl<'a> Shares<'a> {
    pub(crate) fn of(class: &'a ClassModel) -> Self {
        let Rates { recall, concentration, .. } = class.rates;
        let shares: [f64; SHARES] = std::array::from_fn(|k| (k as f64 + 0.5) / SHARES as f64);
        let usual = shares.map(|share| class.rates.density(share));
        let less = shares.map(|share| f64::from(u8::from(share < recall)));
        // As finely as shares are told apart.
        let ghost = shares.map(|share| f64::from(u8::from(share < (GHOSTLY * recall).max(1.0 / SHARES as f64))));
        let ln_of = |weights: &[f64; SHARES], k: usize| (weights[k] / weights.iter().sum::<f64>()).ln();
        let each = std::array::from_fn(|k| {
            let (hit, miss) = (shares[k] * concentration, (1.0 - shares[k]) * concentration);
            let ln_gamma = (ln_gamma(hit), ln_gamma(miss));
            let [ln_usual, ln_less, ln_ghost] = [&usual, &less, &ghost].map(|weights| ln_of(weights, k));
            Share { hit, miss, ln_gamma, ln_usual, ln_less, ln_ghost }
        });
        Self { class, each, ln_gamma: ln_gamma(concentration) }
    }

    /// How probable the looks of a pass are from a side of each share, if it is a usual pass; and if it is an odd one, of which any share is
    /// as probable as `ln_any` says.
    fn of_pass(&self, pass: &Looks, ln_any: f64) -> ([f64; SHARES], f64) {
        let odd = self.class.odd_passes;
        let any = odd * ln_any.exp();
        let ln_all = self.ln_gamma - ln_gamma(self.class.rates.concentration + pass.expected);
        let usual = self.each.map(|share| {
            let (hit, miss) = (share.hit + pass.hits, share.miss + pass.expected - pass.hits);
            let ln_usual = ln_gamma(hit) - share.ln_gamma.0 + ln_gamma(miss) - share.ln_gamma.1 + ln_all;
            (1.0 - odd) * ln_usual.exp()
        });
        (usual, any)
    }
}

/// Logarithm of how probable the looks of a pass are if nothing is known of what is seen.
fn ln_any(pass: &Looks) -> f64 {
    Rates::ANY.log_likelihood(pass.hits, pass.expected)
}

/// Logarithms of how probable the looks of one sector are: if the object is seen from there as usual, if less or differently on each pass,
/// if it is false, and if it is a ghost.
struct OfSector {
    /// From a side of each share.
    of_shares: [f64; SHARES],
    usual: f64,
    any: f64,
    falsely: f64,
    ghost: f64,
    hits: f64,
    expected: f64,
}

impl OfSector {
    fn new(passes: &[Looks], shares: &Shares<'_>) -> Self {
        let (mut each, mut hits, mut expected) = (0.0, 0.0, 0.0);
        let (mut present, mut of_present) = (0, 0.0);
        let mut of_shares = [0.0; SHARES];
        for pass in passes {
            let any = ln_any(pass);
            let (usual, odd) = shares.of_pass(pass, any);
            of_shares.iter_mut().zip(usual).for_each(|(sum, usual)| *sum += (usual + odd).ln());
            each += any;
            hits += pass.hits;
            expected += pass.expected;
            if pass.hits > 0.0 {
                present += 1;
                of_present += any;
            }
        }
        let with = |ln_weight: fn(&Share) -> f64| {
            ln_sum_of(&std::array::from_fn::<f64, SHARES, _>(|k| of_shares[k] + ln_weight(&shares.each[k])))
        };
        let less = with(|share| share.ln_less);
        // What two passes meet at one place does not pass by.
        let passing = if present == 1 { of_present + ln_met_by_one(passes.len()) } else { f64::NEG_INFINITY };
        let (falsely, any) = (ln_sum(passing, less) - LN_2, ln_sum(each, less) - LN_2);
        let (usual, ghost) = (with(|share| share.ln_usual), with(|share| share.ln_ghost));
        Self { of_shares, usual, any, falsely, ghost, hits, expected }
    }

    /// That from where an object has most votes is the greatest.
    fn by_hits(&self, other: &Self) -> Ordering {
        self.hits.total_cmp(&other.hits).then(self.expected.total_cmp(&other.expected))
    }

    /// From as many directions an object is seen as usual as it is not.
    fn either(&self) -> f64 {
        ln_sum(self.usual, self.any) - LN_2
    }
}

/// Logarithm of how probable it is that a certain one of some passes alone meets what is there on any share of them, up to every other, if
/// any does: the mean of `p (1 - p)^(passes - 1)` over p between 0 and 1/2, by that of `1 - (1 - p)^passes`.
fn ln_met_by_one(passes: usize) -> f64 {
    // Half the mean of (1 - p)^(power - 1).
    let up_to = |power: f64| (1.0 - (-power).exp2()) / power;
    let passes = passes as f64;
    (2.0 * (up_to(passes) - up_to(passes + 1.0)) / (1.0 - 2.0 * up_to(passes + 1.0))).ln()
}

/// `ln(sum of e^x)`.
fn ln_sum_of(logarithms: &[f64]) -> f64 {
    let most = logarithms.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    most + logarithms.iter().map(|x| (x - most).exp()).sum::<f64>().ln()
}

/// `ln(e^a + e^b)`.
fn ln_sum(a: f64, b: f64) -> f64 {
    a.max(b) + (-(a - b).abs()).exp().ln_1p()
}

/// How probable all looks at an object are: logarithms.
pub(crate) struct Judged {
    sectors: Vec<OfSector>,
    /// The sector from where it has most votes; nothing if nobody looks.
    main: Option<usize>,
    /// If it is real, seen as usual from where it has most votes; if it is false; and if it is a ghost. From other sides all may be seen as usual or not.
    ln_real: f64,
    ln_false: f64,
    ln_ghost: f64,
    ln_which: f64,
}

impl Judged {
    /// Logarithm of how probable the looks are at anything, real or not.
    pub(crate) fn ln_likelihood(&self) -> f64 {
        self.ln_any() + self.ln_which
    }

    /// Probability that what has these looks is real rather than false or a ghost.
    pub(crate) fn real(&self) -> f64 {
        (self.ln_real - self.ln_any()).exp()
    }

    /// Probability that it is a ghost.
    fn ghost(&self) -> f64 {
        (self.ln_ghost - self.ln_any()).exp()
    }

    fn ln_any(&self) -> f64 {
        ln_sum(ln_sum(self.ln_real, self.ln_false), self.ln_ghost)
    }
}

/// What the looks at an object tell of how often objects are detected, and of ghosts.
pub(crate) struct Told {
    /// Probability that it is real.
    pub real: f64,
    /// Probability that it is a ghost.
    pub ghost: f64,
    /// The looks of all passes from where it has most votes, each with the probability that it is real and seen as usual on this pass.
    pub usual: Vec<(Looks, f64)>,
}

/// The hits and the looks of some passes.
fn sum<'a>(passes: impl Iterator<Item = &'a Looks>) -> (f64, f64) {
    passes.fold((0.0, 0.0), |sum, pass| (sum.0 + pass.hits, sum.1 + pass.expected))
}

impl Seen {
    /// How probable the looks are at an object of a class.
    pub(crate) fn judged(&self, shares: &Shares<'_>) -> Judged {
        let sectors: Vec<OfSector> = self.sectors.iter().map(|passes| OfSector::new(passes, shares)).collect();
        let all: f64 = sectors.iter().map(OfSector::either).sum();
        let main = sectors.iter().enumerate().max_by(|(_, a), (_, b)| a.by_hits(b)).map(|(place, _)| place);
        let [usual, falsely, ghost] = main.map_or([0.0; 3], |main| {
            let main = &sectors[main];
            [main.usual, main.falsely, main.ghost].map(|of_main| all - main.either() + of_main)
        });
        let ghosts = shares.class.ghost_share;
        let ln_no_ghost = (-ghosts).ln_1p();
        Judged {
            sectors,
            main,
            ln_real: usual + (-FALSE_SHARE).ln_1p() + ln_no_ghost,
            ln_false: falsely + FALSE_SHARE.ln() + ln_no_ghost,
            ln_ghost: ghost + ghosts.ln(),
            ln_which: self.ln_which,
        }
    }

    /// Passes that see an object from where it has most votes, or should have; and minus the logarithm of how probable it is of those without a hit
    /// to have none.
    #[must_use]
    pub fn missed(&self, class: &ClassModel) -> (usize, f64) {
        let shares = Shares::of(class);
        let Some(main) = self.judged(&shares).main else { return (0, 0.0) };
        let looked = self.sectors[main].iter().filter(|pass| pass.expected > 0.0);
        let missed = looked.clone().filter(|pass| pass.hits == 0.0);
        (looked.count(), missed.map(|pass| -OfSector::new(&[*pass], &shares).usual).sum())
    }

    /// The share of hits of all looks.
    #[must_use]
    pub fn share(&self) -> f64 {
        let (hits, expected) = sum(self.sectors.iter().flatten());
        if expected > 0.0 { hits / expected } else { 0.0 }
    }

    /// The share of hits from where it has most votes.
    #[must_use]
    pub fn main_share(&self) -> Option<f64> {
        let (hits, expected) = sum(self.main_sector()?.iter());
        (expected > 0.0).then(|| hits / expected)
    }

    /// Whether of the looks from where it has most votes most are of passes that met it. What passes that disagree see is met by one of them.
    #[must_use]
    pub fn is_met_by_most(&self) -> bool {
        let Some(passes) = self.main_sector() else { return false };
        let met = sum(passes.iter().filter(|pass| pass.hits > 0.0));
        2.0 * met.1 > sum(passes.iter()).1
    }

    /// The looks by pass from where it has most votes.
    fn main_sector(&self) -> Option<&Vec<Looks>> {
        self.sectors.iter().max_by(|a, b| sum(a.iter()).0.total_cmp(&sum(b.iter()).0))
    }

    /// What the looks tell of those at objects of the class.
    pub(crate) fn told(&self, shares: &Shares<'_>) -> Told {
        let judged = self.judged(shares);
        let (real, ghost) = (judged.real(), judged.ghost());
        let Some(main) = judged.main else { return Told { real, ghost, usual: Vec::new() } };
        let of_main = &judged.sectors[main];
        let weights: [f64; SHARES] =
            std::array::from_fn(|k| (of_main.of_shares[k] + shares.each[k].ln_usual - of_main.usual).exp());
        let of_pass = |pass: &Looks| {
            let (usual, any) = shares.of_pass(pass, ln_any(pass));
            let usual = weights.iter().zip(usual).map(|(weight, usual)| weight * usual / (usual + any));
            (*pass, real * usual.sum::<f64>())
        };
        let usual = self.sectors[main].iter().map(of_pass).collect();
        Told { real, ghost, usual }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robust::scene::Scene;
    use crate::street::SETTINGS;

    fn class(between: f64) -> ClassModel {
        let rates = Rates { recall: 0.75, concentration: 30.0, between };
        ClassModel {
            rates,
            odd_passes: 0.1,
            ..ClassModel::guess(&Scene::default(), &SETTINGS, 0, (f64::NAN, f64::NAN), (f64::NAN, f64::NAN))
        }
    }

    fn seen(sectors: &[&[(f64, f64)]]) -> Seen {
        let pass = |&(hits, expected): &(f64, f64)| Looks { expected, hits };
        Seen { sectors: sectors.iter().map(|passes| passes.iter().map(pass).collect()).collect(), ln_which: 0.0 }
    }

    fn real(seen: &Seen, between: f64) -> f64 {
        seen.judged(&Shares::of(&class(between))).real()
    }

    #[test]
    fn what_is_seen_more_often_than_usual_on_all_passes_is_real() {
        let often = seen(&[&[(9.0, 9.0), (5.0, 5.0), (9.0, 10.0), (6.0, 6.0), (9.0, 9.0), (7.0, 8.0)]]);
        assert!(real(&often, 0.5) > 0.95);
    }

    #[test]
    fn what_is_seen_less_often_than_usual_is_real_where_sides_differ() {
        let less = seen(&[&[(17.0, 40.0), (16.0, 40.0), (18.0, 40.0), (17.0, 40.0)]]);
        assert!(real(&less, 0.0) < 0.5, "{}", real(&less, 0.0));
        assert!(real(&less, 0.8) > 0.8, "{}", real(&less, 0.8));
    }

    #[test]
    fn what_is_hardly_seen_from_other_sides_is_real() {
        let usual = [(15.0, 20.0); 5];
        let hardly = [(2.0, 20.0), (0.0, 20.0), (1.0, 20.0), (3.0, 20.0), (2.0, 20.0)];
        let alone = real(&seen(&[&usual]), 0.3);
        let beside = real(&seen(&[&usual, &hardly, &hardly, &hardly]), 0.3);
        assert!(alone > 0.9 && (alone - beside).abs() < 1e-9, "{alone} {beside}");
    }

    #[test]
    fn what_one_pass_alone_meets_is_false_and_what_two_meet_is_not() {
        let one = seen(&[&[(14.0, 20.0), (0.0, 20.0), (0.0, 20.0), (0.0, 20.0), (0.0, 20.0)]]);
        assert!(real(&one, 0.3) < 0.05, "{}", real(&one, 0.3));
        let since_then = seen(&[&[(0.0, 20.0), (0.0, 20.0), (0.0, 20.0), (16.0, 20.0), (15.0, 20.0)]]);
        assert!(real(&since_then, 0.3) > 0.5, "{}", real(&since_then, 0.3));
        let most = seen(&[&[(14.0, 20.0), (0.0, 20.0), (15.0, 20.0), (16.0, 20.0), (14.0, 20.0)]]);
        assert!(real(&most, 0.3) > 0.95, "{}", real(&most, 0.3));
    }

    #[test]
    fn passes_miss_an_object_where_it_has_most_votes_or_not_at_all() {
        let side: &[(f64, f64)] = &[(9.0, 10.0), (0.0, 10.0), (8.0, 10.0)];
        let (alone, beside) = (seen(&[side]), seen(&[&[(0.0, 20.0), (1.0, 20.0), (0.0, 20.0)], side]));
        let (passes, missed) = alone.missed(&class(0.3));
        assert!(passes == 3 && missed > 1.0, "{passes} {missed}");
        assert_eq!(beside.missed(&class(0.3)), (passes, missed));
    }

    #[test]
    fn what_is_seen_now_and_then_from_everywhere_is_false() {
        let now_and_then = seen(&[&[(2.0, 20.0), (1.0, 20.0), (3.0, 20.0), (2.0, 20.0)]]);
        assert!(real(&now_and_then, 0.3) < 0.05, "{}", real(&now_and_then, 0.3));
    }

    #[test]
    fn what_hardly_any_look_sees_is_a_ghost_where_many_are() {
        let class = |ghost_share: f64| {
            // Objects differ so much that some are hardly ever seen.
            let rates = Rates { recall: 0.4, concentration: 30.0, between: 1.4 };
            ClassModel { rates, ghost_share, ..class(0.0) }
        };
        let judged = |seen: &Seen, share: f64| seen.judged(&Shares::of(&class(share))).real();
        let hardly = seen(&[&[(1.0, 40.0), (0.0, 40.0), (2.0, 40.0), (1.0, 40.0)]]);
        assert!(judged(&hardly, 0.0) > 0.8 && judged(&hardly, 0.6) < 0.2);
        let often = seen(&[&[(20.0, 40.0), (24.0, 40.0), (18.0, 40.0), (22.0, 40.0)]]);
        assert!(judged(&often, 0.0) > 0.9 && judged(&often, 0.6) > 0.9);
    }

    #[test]
    fn what_passes_by_is_met_by_one_pass_as_often_as_the_integral_says() {
        for passes in [1, 2, 3, 12] {
            let steps = 10_000;
            let share = |i: u32| 0.5 * (f64::from(i) + 0.5) / f64::from(steps);
            let by_one: f64 = (0..steps).map(|i| share(i) * (1.0 - share(i)).powi(passes - 1)).sum();
            let by_any: f64 = (0..steps).map(|i| 1.0 - (1.0 - share(i)).powi(passes)).sum();
            assert!((ln_met_by_one(passes as usize) - (by_one / by_any).ln()).abs() < 1e-6, "{passes}");
        }
    }
}
