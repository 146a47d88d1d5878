//! What a map tells about each class: how often its objects are detected, how large they are, how much clutter there is.

use super::clutter::{elevation_factor, score_ratio};
use super::energy::{Object, implied_size};
use super::heights::{Heights, ground_m2 as ground_m2_within, height_m};
use super::looks::Looks;
use super::model::{ClassModel, FALSE_SHARE, Model, ODD_PASSES, Rates};

/// Objects with fewer votes do not serve.
const MIN_VOTES: usize = 6;
/// The part of the votes that is nearer than what counts as seen from everywhere.
const NEAR_VOTES: f64 = 0.05;
/// Fewer of these tell nothing, and what was thought before stays.
const MIN_OBJECTS: usize = 5;
/// The median absolute deviation of a normal distribution, in standard deviations.
const MAD_OF_NORMAL: f64 = 0.6745;
/// A spread of sizes is no smaller: boxes are whole pixels, and edges are not the same all around.
const LEAST_SPREAD: f64 = 0.03;

/// Learn the classes of a model from the objects that some rays make.
pub fn learn(model: &mut Model<'_>, rays: &[u32], objects: &[Object]) {
    let solid_angle_sr = model.solid_angle_sr(rays.len());
    let ground_m2 = ground_m2(model, objects);
    let mut is_vote = vec![false; model.scene.rays.rays.len()];
    objects.iter().flat_map(|object| &object.votes).for_each(|&ray| is_vote[ray as usize] = true);
    let looked_at = span(&model.sin_elevation);
    for class in 0..model.classes.len() as u32 {
        let of_class: Vec<&Object> = objects.iter().filter(|object| object.class == class).collect();
        let is_sure = |object: &&Object| object.votes.len() >= MIN_VOTES && object.real > 0.5;
        let sure: Vec<&Object> = of_class.iter().copied().filter(is_sure).collect();
        let before = model.classes[class as usize];
        // One detection more than is seen: no clutter at all is never known for sure.
        let (in_class, clutter): (Vec<u32>, Vec<u32>) = rays
            .iter()
            .copied()
            .filter(|&ray| model.scene.rays.class[ray as usize] == class)
            .partition(|&ray| is_vote[ray as usize]);
        let ln_clutter_per_sr = ((clutter.len() + 1) as f64 / solid_angle_sr).ln();
        let mut learned = ClassModel { ln_clutter_per_sr, ..before };
        let of = |column: &[f64], rays: &[u32]| rays.iter().map(|&ray| column[ray as usize]).collect::<Vec<f64>>();
        learned.score_ratio = score_ratio(&of(&model.scene.score, &in_class), &of(&model.scene.score, &clutter));
        learned.clutter_by_elevation = elevation_factor(&of(&model.sin_elevation, &clutter), looked_at);
        if sure.len() >= MIN_OBJECTS {
            (learned.rates, learned.odd_passes) = rates(&sure, &before);
            let false_share = of_class.iter().map(|object| 1.0 - object.real).sum::<f64>() / of_class.len() as f64;
            learned.false_share = false_share.clamp(FALSE_SHARE.0, FALSE_SHARE.2);
            learned.nearest_m = nearest_m(model, &sure);
            let (spread, object) = sizes(model, &sure);
            learned.sizes.spread = spread.max(LEAST_SPREAD);
            learned.sizes.object = (object.0, object.1.max(learned.sizes.spread));
            learned.heights = heights(model, &sure);
            learned.ln_births_per_m2 = (of_class.len() as f64 / ground_m2).ln();
        }
        model.classes[class as usize] = learned;
    }
}

/// The ground from which objects are seen, m²: as far from the cameras as all but few votes are; nothing where nobody knows what is up.
fn ground_m2(model: &Model<'_>, objects: &[Object]) -> f64 {
    let sure: Vec<&Object> = objects.iter().filter(|object| object.votes.len() >= MIN_VOTES).collect();
    let mut distances = distances_m(model, &sure);
    let place = (distances.len() as f64 * (1.0 - NEAR_VOTES)) as usize;
    match model.up {
        Some(up) if place < distances.len() => {
            ground_m2_within(model.scene, &up, *distances.select_nth_unstable_by(place, f64::total_cmp).1)
        }
        _ => f64::NAN,
    }
}

/// How high objects are above the cameras.
fn heights(model: &Model<'_>, objects: &[&Object]) -> Option<Heights> {
    let up = model.up?;
    let of_object = |object: &&Object| {
        let height_m = height_m(model.scene, model.up, &object.votes, &object.fit.point)?;
        Some((height_m, up.dot(&(object.fit.covariance * up)).sqrt()))
    };
    let (heights_m, sigmas_m): (Vec<f64>, Vec<f64>) = objects.iter().filter_map(of_object).unzip();
    Heights::learn(&heights_m, &sigmas_m, model.settings.viability.max_range_m)
}

/// The least and the greatest of some numbers, those that are not numbers aside.
fn span(numbers: &[f64]) -> (f64, f64) {
    numbers
        .iter()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(least, most), &number| (least.min(number), most.max(number)))
}

/// The distance from which on all but a few votes are cast, m.
fn nearest_m(model: &Model<'_>, objects: &[&Object]) -> f64 {
    let mut distances = distances_m(model, objects);
    let place = (distances.len() as f64 * NEAR_VOTES) as usize;
    *distances.select_nth_unstable_by(place, f64::total_cmp).1
}

/// How far all votes are from their objects, m.
fn distances_m(model: &Model<'_>, objects: &[&Object]) -> Vec<f64> {
    let of_object = |object: &&Object| -> Vec<f64> {
        object.votes.iter().map(|&ray| (model.scene.ray(ray).center - object.fit.point).norm()).collect()
    };
    objects.iter().flat_map(of_object).collect()
}

/// The spread of the sizes of one object, and mean and standard deviation of those of all.
fn sizes(model: &Model<'_>, objects: &[&Object]) -> (f64, (f64, f64)) {
    let (mut away, mut medians) = (Vec::new(), Vec::new());
    for object in objects {
        let sizes = object.votes.iter().map(|&ray| implied_size(model, ray, &object.fit.point));
        let mut sizes: Vec<f64> = sizes.filter(|size| size.is_finite()).collect();
        if let Some(median) = median(&mut sizes) {
            away.extend(sizes.iter().map(|size| (size - median).abs()));
            medians.push(median);
        }
    }
    let spread = median(&mut away).unwrap_or(f64::NAN) / MAD_OF_NORMAL;
    let middle = median(&mut medians).unwrap_or(f64::NAN);
    for size in &mut medians {
        *size = (*size - middle).abs();
    }
    (spread, (middle, median(&mut medians).unwrap_or(f64::NAN) / MAD_OF_NORMAL))
}

fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// How often objects are detected in the usual pass, how much that differs between them, and the share of odd passes: one step of expectation and
/// maximisation.
fn rates(objects: &[&Object], before: &ClassModel) -> (Rates, f64) {
    let mut passes: Vec<(Looks, f64)> = objects.iter().flat_map(|object| object.seen.usual(before)).collect();
    passes.retain(|(pass, _)| pass.expected >= 3.0);
    let (mut hits, mut expected, mut shares, mut count) = (0.0, 0.0, 0.0, 0.0_f64);
    for (pass, share) in &passes {
        hits += share * pass.hits;
        expected += share * pass.expected;
        shares += share;
        count += 1.0;
    }
    if expected < 30.0 {
        return (before.rates, before.odd_passes);
    }
    let recall = f64::clamp(hits / expected, 0.05, 0.98);
    // Method of moments: the variance of a pass's share is p (1 - p) (1 + (n - 1) / (1 + s)) / n.
    let mut excess = (0.0, 0.0);
    for (pass, share) in &passes {
        let n = pass.expected;
        let away = pass.hits / n - recall;
        excess.0 += share * (n * away * away - recall * (1.0 - recall));
        excess.1 += share * (n - 1.0) * recall * (1.0 - recall);
    }
    let correlation = f64::clamp(excess.0 / excess.1, 0.01, 0.5);
    let odd = (1.0 - shares / count).clamp(ODD_PASSES.0, ODD_PASSES.2);
    (Rates { recall, concentration: 1.0 / correlation - 1.0 }, odd)
}
