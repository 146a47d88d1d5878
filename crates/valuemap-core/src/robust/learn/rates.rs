//! How often objects are detected, how much that differs between them, the share of odd passes, and that of ghosts: by expectation and maximisation
//! (Dempster, Laird and Rubin 1977), so that what is false in the end has told nothing. They are the rates of equation (5) of `docs/method.md`; the
//! share of ghosts is equation (10).

use rayon::prelude::*;

use crate::robust::energy::Object;
use crate::robust::energy::seen::{Looks, Shares, Told};
use crate::robust::model::{ClassModel, FALSE_SHARE, ODD_PASSES, Rates, median};

/// Steps of expectation and maximisation: some ten change the rates by less than a thousandth.
const STEPS: usize = 20;
/// Shares of odd passes that are compared: so many that a tenth of their deviation is between two where a thousand passes tell.
const ODD_SHARES: usize = 45;
/// Passes of fewer looks do not tell how much passes differ. One look tells nothing of it, and of two, chance makes no less than all that passes may differ by.
const LEAST_LOOKS_OF_PASS: f64 = 3.0;
/// Rates of fewer looks are known worse than to a tenth.
pub(crate) const LEAST_LOOKS: f64 = 30.0;
/// How alike looks of one pass are: at least, at most. Concentrations are from 1, as where nothing is known (`Rates::ANY`), to 99, as of what is alike
/// (`Rates::ALIKE`).
const CORRELATION: (f64, f64) = (0.01, 0.5);
/// Ghosts are as rare as if no more objects than these had been met, none of them a ghost: of fewer, one cannot be told from other false things, which
/// are one in so many.
const NO_GHOSTS: f64 = 1.0 / FALSE_SHARE;

/// A class with what the looks at some objects tell. From two starts, the likelier: objects that differ much, of which few are false, and objects that
/// are alike, as most votes are for.
pub(super) fn with_rates(objects: &[&Object], class: &ClassModel, has_ghosts: bool) -> ClassModel {
    let of_votes = |object: &&Object| object.seen.main_share().map(|share| vec![share; object.votes.len()]);
    let mut shares: Vec<f64> = objects.iter().filter_map(of_votes).flatten().collect();
    let alike = median(&mut shares).map_or(Rates::ALIKE, |share| Rates { recall: recall(share), ..Rates::ALIKE });
    let from = |rates: Rates| {
        let ghost_share = if has_ghosts { FALSE_SHARE } else { 0.0 };
        let class = learned_rates(objects, ClassModel { rates, odd_passes: ODD_PASSES.1, ghost_share, ..*class })?;
        Some((ln_likelihood(objects, &class), class))
    };
    let (differing, alike) = rayon::join(|| from(Rates::GUESS), || from(alike));
    let starts = [differing, alike].into_iter().flatten();
    let Some((_, likeliest)) = starts.max_by(|a, b| a.0.total_cmp(&b.0)) else { return *class };
    ClassModel { odd_passes: odd_passes(objects, &likeliest), ..likeliest }
}

/// The share of odd passes to expect, whatever it is within its bounds: where few objects tell, the likeliest share is as good as any other.
fn odd_passes(objects: &[&Object], class: &ClassModel) -> f64 {
    let (least, _, most) = ODD_PASSES;
    let shares: [f64; ODD_SHARES] =
        std::array::from_fn(|k| least + (most - least) * (k as f64 + 0.5) / ODD_SHARES as f64);
    let ln_likelihood = |&odd_passes: &f64| ln_likelihood(objects, &ClassModel { odd_passes, ..*class });
    let ln_likelihoods: Vec<f64> = shares.par_iter().map(ln_likelihood).collect();
    let highest = ln_likelihoods.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let weights: Vec<f64> = ln_likelihoods.iter().map(|of_share| (of_share - highest).exp()).collect();
    let sum: f64 = weights.iter().zip(shares).map(|(weight, share)| weight * share).sum();
    sum / weights.iter().sum::<f64>()
}

/// Logarithm of how probable the looks at some objects are.
fn ln_likelihood(objects: &[&Object], class: &ClassModel) -> f64 {
    let shares = Shares::of(class);
    objects.iter().map(|object| object.seen.judged(&shares).ln_likelihood()).sum()
}

/// The rates from one start; nothing if there are few looks.
fn learned_rates(objects: &[&Object], mut class: ClassModel) -> Option<ClassModel> {
    for _ in 0..STEPS {
        let shares = Shares::of(&class);
        let told: Vec<Told> = objects.par_iter().map(|object| object.seen.told(&shares)).collect();
        let ghosts: f64 = told.iter().map(|told| told.ghost).sum();
        let tells = |(pass, _): &(Looks, f64)| pass.expected >= LEAST_LOOKS_OF_PASS;
        let of_object = |told: Told| (told.real, told.usual.into_iter().filter(tells).collect());
        let (real, sides): (Vec<f64>, Vec<Vec<(Looks, f64)>>) = told.into_iter().map(of_object).unzip();
        let real: f64 = real.iter().zip(&sides).map(|(real, passes)| real * passes.len() as f64).sum();
        let odd = 1.0 - sides.iter().flatten().map(|pass| pass.1).sum::<f64>() / real;
        let rates = rates_of(&sides)?;
        let ghost_share = ghosts / (objects.len() as f64 + NO_GHOSTS);
        class = ClassModel { rates, odd_passes: odd.clamp(ODD_PASSES.0, ODD_PASSES.2), ghost_share, ..class };
    }
    Some(class)
}

/// A share of hits as a rate: no detector sees all, and none that serves sees nothing.
fn recall(share: f64) -> f64 {
    share.clamp(0.05, 0.98)
}

/// Detection rates by the method of moments, from looks by side and pass that each count in part. Nothing of few looks.
fn rates_of(sides: &[Vec<(Looks, f64)>]) -> Option<Rates> {
    let all = || sides.iter().flatten();
    let expected: f64 = all().map(|(looks, share)| share * looks.expected).sum();
    let hits: f64 = all().map(|(looks, share)| share * looks.hits).sum();
    if expected < LEAST_LOOKS {
        return None;
    }
    let recall = recall(hits / expected);
    let variance = recall * (1.0 - recall);
    // The variance of a share of n looks is p (1 - p) (1 + (n - 1) / (1 + s)) / n.
    let (mut excess, mut most) = (0.0, 0.0);
    for (looks, share) in all() {
        let n = looks.expected;
        let away = looks.hits / n - recall;
        excess += share * (n * away * away - variance);
        most += share * (n - 1.0) * variance;
    }
    let of_all = f64::clamp(excess / most, CORRELATION.0, CORRELATION.1);
    // Two passes of one side have in common what sides differ by.
    let (mut common, mut pairs) = (0.0, 0.0);
    for passes in sides {
        let [mut away, mut looks, mut away2, mut looks2] = [0.0; 4];
        for (pass, share) in passes {
            let (a, n) = (share * (pass.hits - recall * pass.expected), share * pass.expected);
            (away, looks, away2, looks2) = (away + a, looks + n, away2 + a * a, looks2 + n * n);
        }
        if looks > 0.0 {
            common += (away * away - away2) / looks;
            pairs += (looks * looks - looks2) / looks;
        }
    }
    let of_sides = if pairs > 0.0 { f64::clamp(common / (pairs * variance), 0.0, of_all - CORRELATION.0) } else { 0.0 };
    let within = f64::clamp((of_all - of_sides) / (1.0 - of_sides), CORRELATION.0, CORRELATION.1);
    // The derivative of the logit is 1 / (p (1 - p)).
    Some(Rates { recall, concentration: 1.0 / within - 1.0, between: (of_sides / variance).sqrt() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robust::energy::anywhere;
    use crate::robust::energy::seen::Seen;
    use crate::robust::scene::Scene;
    use crate::street::SETTINGS;

    /// An object that all passes see as usual from one side, and hardly any from another.
    fn seen_from_one_side() -> Object {
        let pass = |hits: f64| Looks { expected: 20.0, hits };
        let sectors = [[20.0, 8.0, 16.0, 12.0, 18.0, 10.0], [0.0, 0.0, 1.0, 0.0, 2.0, 0.0]]
            .map(|hits| hits.into_iter().map(pass).collect())
            .to_vec();
        anywhere(1, Seen { sectors, ln_which: 0.0 }, -100.0)
    }

    #[test]
    fn passes_are_not_odd_from_where_an_object_is_not_seen() {
        let objects: Vec<Object> = (0..9).map(|_| seen_from_one_side()).collect();
        let class = taught_by(&objects);
        assert!((class.rates.recall - 0.7).abs() < 0.05, "{:?}", class.rates);
        assert!(class.odd_passes < 0.1, "{}", class.odd_passes);
    }

    #[test]
    fn few_objects_do_not_tell_that_hardly_any_pass_is_odd() {
        let seen = |hits: f64| {
            let passes = vec![Looks { expected: 20.0, hits }];
            anywhere(1, Seen { sectors: vec![passes], ln_which: 0.0 }, -100.0)
        };
        let of = |count: usize| -> Vec<Object> { (0..count).map(|i| seen(16.0 + (i % 3) as f64)).collect() };
        let (few, many) = (taught_by(&of(6)), taught_by(&of(600)));
        assert!(few.odd_passes > 0.12 && many.odd_passes < 0.06, "{} {}", few.odd_passes, many.odd_passes);
        // So what is seen less there may be real after all.
        let less = seen(3.0).seen;
        let [by_few, by_many] = [&few, &many].map(|class| less.judged(&Shares::of(class)).real());
        assert!(by_few > 0.5 && by_many < 0.4, "{by_few} {by_many}");
    }

    #[test]
    fn what_looks_like_an_object_at_times_does_not_tell_how_often_objects_are_seen() {
        let seen = |hits: &[f64]| {
            let passes = hits.iter().map(|&hits| Looks { expected: 40.0, hits }).collect();
            anywhere(1, Seen { sectors: vec![passes], ln_which: 0.0 }, -100.0)
        };
        let objects = (0..60).map(|i| seen(&[34.0 + f64::from(i % 5), 38.0 - f64::from(i % 3)]));
        let lookalikes = (0..12).map(|i| seen(&[17.0 + f64::from(i % 9), 22.0 - f64::from(i % 7)]));
        let all: Vec<Object> = objects.chain(lookalikes).collect();
        let class = taught_by(&all);
        assert!(class.rates.recall > 0.88 && class.rates.concentration > 15.0, "{:?}", class.rates);
        let least = all[..60].iter().map(|object| object.seen.judged(&Shares::of(&class)).real()).fold(1.0, f64::min);
        let most = all[60..].iter().map(|object| object.seen.judged(&Shares::of(&class)).real()).fold(0.0, f64::max);
        assert!(least > 0.9 && most < 0.5, "{least} {most}");
    }

    #[test]
    fn objects_that_all_looks_see_have_rates_as_well() {
        let passes = || vec![Looks { expected: 12.0, hits: 12.0 }];
        let objects: Vec<Object> =
            (0..20).map(|_| anywhere(1, Seen { sectors: vec![passes()], ln_which: 0.0 }, -100.0)).collect();
        let class = taught_by(&objects);
        let Rates { recall, concentration, between } = class.rates;
        assert!(recall > 0.9 && concentration > 1.0 && between >= 0.0, "{:?}", class.rates);
        assert!(objects[0].seen.judged(&Shares::of(&class)).real() > 0.9);
    }

    /// Objects that are detected in four of five looks, and things that hardly any look hits.
    fn objects_and_ghosts(objects: usize, ghosts: usize) -> Vec<Object> {
        let seen = |hits: [f64; 4]| {
            let passes = hits.iter().map(|&hits| Looks { expected: 50.0, hits }).collect();
            anywhere(1, Seen { sectors: vec![passes], ln_which: 0.0 }, -100.0)
        };
        let real = (0..objects).map(|i| i as f64).map(|i| seen([37.0 + i % 5.0, 40.0, 42.0 - i % 4.0, 39.0]));
        let hardly = (0..ghosts).map(|i| i as f64).map(|i| seen([i % 4.0, 2.0 + i % 7.0, i % 3.0, 1.0]));
        real.chain(hardly).collect()
    }

    #[test]
    fn many_ghosts_do_not_tell_that_objects_are_hardly_detected() {
        let all = objects_and_ghosts(30, 70);
        let class = taught_by(&all);
        assert!((class.rates.recall - 0.8).abs() < 0.02 && class.rates.between < 0.4, "{:?}", class.rates);
        assert!((class.ghost_share - 70.0 / 110.0).abs() < 0.02, "{}", class.ghost_share);
        let real: Vec<f64> = all.iter().map(|object| object.seen.judged(&Shares::of(&class)).real()).collect();
        assert!(real[..30].iter().all(|&real| real > 0.95) && real[30..].iter().all(|&real| real < 0.05), "{real:?}");
        let without = with_rates(&all.iter().collect::<Vec<_>>(), &guess(), false);
        assert!(without.ghost_share == 0.0 && without.rates.between > 1.0, "{:?}", without.rates);
    }

    #[test]
    fn there_are_no_ghosts_where_nothing_is_like_one() {
        assert!(taught_by(&objects_and_ghosts(30, 0)).ghost_share < 1e-3);
        // One of a few is as rare as false things are.
        let one = taught_by(&objects_and_ghosts(5, 1)).ghost_share;
        assert!(one < FALSE_SHARE, "{one}");
    }

    /// A class with what the looks at some objects tell.
    fn taught_by(objects: &[Object]) -> ClassModel {
        with_rates(&objects.iter().collect::<Vec<_>>(), &guess(), true)
    }

    /// What is thought of a class at first.
    fn guess() -> ClassModel {
        ClassModel::guess(&Scene::default(), &SETTINGS, 0, (f64::NAN, f64::NAN), (f64::NAN, f64::NAN))
    }

    #[test]
    fn what_sides_differ_by_is_told_from_what_passes_differ_by() {
        let pass = |hits: f64| (Looks { expected: 20.0, hits }, 1.0);
        let of_sides = |hits: &[[f64; 4]]| {
            let sides: Vec<Vec<(Looks, f64)>> =
                hits.iter().map(|side| side.iter().map(|&h| pass(h)).collect()).collect();
            rates_of(&sides).unwrap_or(Rates::ANY)
        };
        let by_side = of_sides(&[[18.0, 17.0, 18.0, 19.0], [8.0, 9.0, 8.0, 7.0], [13.0, 14.0, 12.0, 13.0]]);
        let by_pass = of_sides(&[[18.0, 8.0, 13.0, 14.0], [17.0, 9.0, 12.0, 13.0], [18.0, 8.0, 19.0, 7.0]]);
        assert!(by_side.between > 0.6 && by_side.concentration > 50.0, "{by_side:?}");
        assert!(by_pass.between < 0.1 && by_pass.concentration < 20.0, "{by_pass:?}");
        assert!((by_side.recall - by_pass.recall).abs() < 1e-9);
    }
}
