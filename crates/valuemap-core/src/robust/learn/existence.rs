//! Which objects exist: what tells them from false things beside the looks at them.
//!
//! J says whether anything is there, and the looks how many of the things with such looks are real (see [`crate::robust::energy::seen`]). Where each has few looks, these
//! say much the same of all. But what is false, an apron of a driveway or a reflection, has lower scores and stands apart from others, and nobody votes for
//! it from nearby: rays from far away meet by chance more easily. So the odds of real against false are multiplied by how much more probable the mean score
//! of an object, its distance to the nearest sure one, and its distance to its nearest vote are of real things than of false ones. The ratios are monotone,
//! and learned by expectation and maximisation (Dempster, Laird and Rubin 1977). How many are real stays what the looks say: these numbers tell which ones.

use super::company::Sure;
use super::counts::{MOST, at_most};
use crate::robust::energy::Object;
use crate::robust::model::Model;
use crate::robust::model::existing::Existing;
use crate::robust::model::steps::{BINS, LEAST_DETECTIONS, rising_ratio};
use crate::robust::parts::Part;

/// Steps of expectation and maximisation: as many more change no probability by more than a hundredth.
const STEPS: usize = 40;
/// No probability is surer than this, so that odds stay finite: no looks tell so much.
const LEAST_DOUBT: f64 = 1e-6;

/// Fewer things tell nothing: a step that is told by a handful says what these happen to be like.
const LEAST_TOLD: f64 = BINS as f64 * LEAST_DETECTIONS;

/// What tells whether an object exists.
#[derive(Debug, Clone, Copy)]
struct Told {
    /// The probability that it is no clutter: what J says.
    there: f64,
    /// The probability that it is real rather than false then: what the looks say.
    real: f64,
    /// The mean score of its votes; not a number if none has one.
    score: f64,
    /// Minus the distance to the nearest sure object of its class that an image shows beside it, m; not a number if there is none.
    nearness: f64,
    /// Minus the distance to the nearest image that votes for it, m.
    approach: f64,
}

impl Told {
    fn ln_odds(&self) -> f64 {
        (self.real / (1.0 - self.real)).ln()
    }
}

/// By expectation and maximisation from what J and the looks say of some things.
fn existing_of(told: &[Told]) -> Existing {
    let real_of = |existing: &Existing| -> Vec<f64> { told.iter().map(|one| real(existing, one)).collect() };
    let sum = |real: &[f64]| -> f64 { told.iter().zip(real).map(|(one, real)| one.there * real).sum() };
    let mut existing = Existing::UNTOLD;
    if told.iter().map(|one| one.there).sum::<f64>() < LEAST_TOLD {
        return existing;
    }
    let mut real = real_of(&existing);
    let all = sum(&real);
    for _ in 0..STEPS {
        let of = |number: fn(&Told) -> f64| -> Vec<(f64, [f64; 2])> {
            let kinds = |(one, real): (&Told, &f64)| (number(one), [one.there * real, one.there * (1.0 - real)]);
            told.iter().zip(&real).map(kinds).collect()
        };
        let numbers: [fn(&Told) -> f64; 3] = [|one| one.score, |one| one.nearness, |one| one.approach];
        let [by_score, by_nearness, by_approach] = numbers.map(|number| rising_ratio(&of(number)));
        existing = Existing { by_score, by_nearness, by_approach, ln_odds: 0.0 };
        if existing.tells_nothing() {
            return Existing::UNTOLD;
        }
        let with = |ln_odds: f64| Existing { ln_odds, ..existing };
        existing = with(at_most(all, MOST, |ln_odds| sum(&real_of(&with(ln_odds)))));
        real = real_of(&existing);
    }
    existing
}

/// The probability that what is no clutter is real rather than false.
fn real(existing: &Existing, told: &Told) -> f64 {
    let by_numbers = existing.by_score.at(told.score)
        + existing.by_nearness.at(told.nearness)
        + existing.by_approach.at(told.approach);
    probability(told.ln_odds() + existing.ln_odds + by_numbers)
}

fn probability(ln_odds: f64) -> f64 {
    1.0 / (1.0 + (-ln_odds).exp())
}

/// What tells of each of some objects and then of some of few votes, whether it exists.
fn told_of(model: &Model<'_>, objects: &[Object], few: &[Object]) -> Vec<Told> {
    let sure = Sure::of_classes(model, objects);
    let told = |(object, row): (&Object, Option<usize>)| {
        let scores = object.votes.iter().map(|&ray| model.scene.score[ray as usize]).filter(|score| score.is_finite());
        let (sum, count) = scores.fold((0.0, 0.0), |(sum, count), score| (sum + score, count + 1.0));
        let nearness = sure[object.class as usize].nearness_beside(model, objects, object, row);
        let real = object.real.clamp(LEAST_DOUBT, 1.0 - LEAST_DOUBT);
        let away_m = object.votes.iter().map(|&ray| (model.scene.ray(ray).center - object.fit.point).norm());
        let approach = -away_m.fold(f64::INFINITY, f64::min);
        Told { there: probability(-0.5 * object.energy), real, score: sum / count, nearness, approach }
    };
    let rows = (0..objects.len()).map(Some).chain(few.iter().map(|_| None));
    objects.iter().chain(few).zip(rows).map(told).collect()
}

/// Learn it for all classes of a model, from the objects of a map and those of few votes beside it.
pub fn learn_existence(model: &mut Model<'_>, objects: &[Object], few: &[Object]) {
    if !model.settings.has(Part::Existence) {
        return;
    }
    let told = told_of(model, objects, few);
    model.pooled.existing = existing_of(&told);
    if let [only] = &mut model.classes[..] {
        only.existing = model.pooled.existing;
        return;
    }
    for (class, learned) in (0..).zip(&mut model.classes) {
        let of_class = objects.iter().chain(few).zip(&told).filter(|(object, _)| object.class == class);
        learned.existing = existing_of(&of_class.map(|(_, told)| *told).collect::<Vec<_>>());
    }
}

/// The probability that each of some objects exists, and then of some of few votes.
#[must_use]
pub fn existences(model: &Model<'_>, objects: &[Object], few: &[Object]) -> Vec<f64> {
    // As in most scenes: what would tell is not asked for.
    if model.classes.iter().all(|class| class.existing.tells_nothing()) {
        return objects.iter().chain(few).map(Object::existence).collect();
    }
    let existence = |(object, told): (&Object, Told)| {
        let existing = &model.classes[object.class as usize].existing;
        if existing.tells_nothing() { object.existence() } else { told.there * real(existing, &told) }
    };
    objects.iter().chain(few).zip(told_of(model, objects, few)).map(existence).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::robust::energy::anywhere;
    use crate::robust::energy::seen::Seen;
    use crate::robust::parts::Without;
    use crate::robust::scene::Scene;
    use crate::robust::settings::Settings;
    use crate::street::{NOISE, SETTINGS, street};

    /// Two in three are real.
    fn is_real(i: usize) -> bool {
        !i.is_multiple_of(3)
    }

    /// Objects of which two in three are real; scores of these are higher, and others are near them.
    fn told(count: usize, real: f64) -> Vec<Told> {
        let one = |i: usize| {
            let (is_real, at_random) = (is_real(i), (i * 7 % 100) as f64 / 100.0);
            let score = if is_real { 0.5 + 0.5 * at_random } else { 0.8 * at_random };
            let nearness = if is_real { -20.0 * at_random } else { -60.0 * ((i * 11 % 100) as f64 / 100.0) };
            Told { there: 1.0, real, score, nearness, approach: f64::NAN }
        };
        (0..count).map(one).collect()
    }

    #[test]
    fn scores_and_company_tell_which_are_real_and_not_how_many() {
        // Looks know a little of which are.
        let mut all = told(900, 0.7);
        all.iter_mut().enumerate().for_each(|(i, one)| one.real += if is_real(i) { 0.05 } else { -0.05 });
        let existing = existing_of(&all);
        let sum = |real_ones: bool, real: fn(&Existing, &Told) -> f64| -> f64 {
            let of = all.iter().enumerate().filter(|(i, _)| is_real(*i) == real_ones);
            of.map(|(_, one)| real(&existing, one)).sum()
        };
        let by_looks = sum(true, |_, one| one.real) + sum(false, |_, one| one.real);
        let (real, falsely) = (sum(true, real), sum(false, real));
        assert!((real + falsely - by_looks).abs() < 1e-3, "{by_looks}");
        assert!(real > 0.9 * 600.0 && falsely < 0.4 * 300.0, "{real} {falsely}");
    }

    #[test]
    fn of_few_that_do_not_exist_nothing_is_learned() {
        assert_eq!(existing_of(&told(900, 0.99)), Existing::UNTOLD);
        assert_eq!(existing_of(&[]), Existing::UNTOLD);
    }

    #[test]
    fn of_few_things_nothing_is_learned() {
        let [few, enough] = [119, 120].map(|count| existing_of(&told(count, 0.7)));
        assert!(few == Existing::UNTOLD && enough != Existing::UNTOLD);
    }

    #[test]
    fn what_is_learned_is_what_is_stored_of_it() {
        let existing = existing_of(&told(900, 0.7));
        let row: Result<[f64; Existing::NUMBERS], _> = existing.to_row().try_into();
        assert!(row.is_ok_and(|row| Existing::from_row(&row) == Some(existing)));
    }

    #[test]
    fn of_two_objects_that_were_seen_alike_the_one_with_the_higher_scores_exists_rather() {
        let signs: Vec<Vector3<f64>> = (1..20).map(|i| Vector3::new(20.0 * f64::from(i), 4.0, 3.0)).collect();
        let mut scene = street(200, 2.0, &signs, &[[0.0; 2]]);
        let scores: Vec<f64> = told(scene.score.len(), 0.7).iter().map(|told| told.score).collect();
        scene.score.clone_from(&scores);
        let few: Vec<Object> = (0..scores.len()).map(of_one_vote).collect();
        let [real, falsely] = mean_existences(&scene, &SETTINGS, &few);
        assert!(real > 0.85 && falsely < 0.5, "{real} {falsely}");
        let names = ["existence".to_owned()];
        let without = Without::named(&names);
        let left_out = mean_existences(&scene, &Settings { without: without.unwrap_or_default(), ..SETTINGS }, &few);
        assert!((left_out[0] - 0.75).abs() < 1e-3 && (left_out[1] - 0.65).abs() < 1e-3, "{left_out:?}");
    }

    #[test]
    fn of_two_objects_that_were_seen_alike_the_one_that_was_voted_for_from_nearer_exists_rather() {
        let signs: Vec<Vector3<f64>> = (1..20).map(|i| Vector3::new(20.0 * f64::from(i), 4.0, 3.0)).collect();
        let scene = street(200, 2.0, &signs, &[[0.0; 2]]);
        let at = |ray: usize| {
            let at_random = (ray * 7 % 100) as f64 / 100.0;
            let away_m = if is_real(ray) { 5.0 + 25.0 * at_random } else { 15.0 + 60.0 * at_random };
            let cast = scene.ray(ray as u32);
            let mut object = of_one_vote(ray);
            object.fit.point = cast.center + away_m * cast.direction;
            object
        };
        let few: Vec<Object> = (0..scene.score.len()).map(at).collect();
        let [real, falsely] = mean_existences(&scene, &SETTINGS, &few);
        assert!(real > 0.85 && falsely < 0.5, "{real} {falsely}");
    }

    /// What looks know a little of.
    fn of_one_vote(ray: usize) -> Object {
        let real = if is_real(ray) { 0.75 } else { 0.65 };
        Object { votes: vec![ray as u32], real, ..anywhere(1, Seen::default(), -20.0) }
    }

    /// The mean existence of the real ones of some objects, and of the false ones.
    fn mean_existences(scene: &Scene, settings: &Settings, few: &[Object]) -> [f64; 2] {
        let mut model = Model::new(scene, &NOISE, settings);
        learn_existence(&mut model, &[], few);
        let existence = existences(&model, &[], few);
        [true, false].map(|real_ones| {
            let of: Vec<f64> = (0..few.len()).filter(|i| is_real(*i) == real_ones).map(|i| existence[i]).collect();
            of.iter().sum::<f64>() / of.len() as f64
        })
    }
}
