//! Heights of the objects of a class above the cameras: they locate objects that few images see.
//!
//! They are a mixture of up to three normal distributions, since lights hang on masts and stand on poles, and a share of objects
//! that are anywhere. The mixture is learned from objects that many images fix, with as many parts as the Bayesian information
//! criterion (Schwarz, 1978) asks for. Its density is a factor of `births_c` in equation (2) of `docs/method.md`.

use std::f64::consts::PI;

use nalgebra::Vector3;
use rustc_hash::FxHashSet;

use super::{ODD, median};
use crate::robust::scene::Scene;

/// Normal distributions that are tried, at most. One more than lights have, which hang on masts and stand on poles; how many serve the Bayesian information
/// criterion tells.
const MOST_COMPONENTS: usize = 3;
/// Rounds of expectation and maximisation, at most. It bounds the work: they end where no mean moves by a thousandth of what heights are known to.
const ROUNDS: usize = 50;

/// A normal distribution among others.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Component {
    /// Its share of the objects.
    pub share: f64,
    /// Its mean, m.
    pub mean_m: f64,
    /// Its standard deviation, m.
    pub sigma_m: f64,
}

/// The heights of the objects of a class above the cameras that see them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Heights {
    /// The distributions; their shares add up to 1, those of the last may be 0.
    pub components: [Component; MOST_COMPONENTS],
    /// Logarithm of the density of what is anywhere, 1/m.
    ln_elsewhere: f64,
}

impl Heights {
    /// Those of some objects, m, each known with a standard deviation, m; what is anywhere is within `range_m` of the cameras. Nothing of no objects.
    #[must_use]
    pub fn learn(heights_m: &[f64], sigmas_m: &[f64], range_m: f64) -> Option<Self> {
        let mut known_m: Vec<f64> = sigmas_m.iter().copied().filter(|sigma_m| sigma_m.is_finite()).collect();
        let floor_m = median(&mut known_m)?;
        let ln_elsewhere = ODD.ln() - (2.0 * range_m).ln();
        let of_components = (1..=MOST_COMPONENTS).map(|count| {
            let heights = Self { components: components(heights_m, count, floor_m), ln_elsewhere };
            let likelihood: f64 = heights_m.iter().map(|&height| heights.ln_density(height)).sum();
            let parameters = (3 * count - 1) as f64;
            (parameters * (heights_m.len() as f64).ln() - 2.0 * likelihood, heights)
        });
        let likeliest = of_components.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, heights)| heights);
        likeliest.map(|heights| Self {
            components: heights.components.map(|component| component.of_another(heights_m.len())),
            ..heights
        })
    }

    /// As many numbers.
    pub const NUMBERS: usize = 3 * MOST_COMPONENTS + 1;

    /// As numbers, for storage.
    #[must_use]
    pub fn to_row(&self) -> [f64; Self::NUMBERS] {
        std::array::from_fn(|place| match self.components.get(place / 3) {
            Some(component) => [component.share, component.mean_m, component.sigma_m][place % 3],
            None => self.ln_elsewhere,
        })
    }

    /// What `to_row` returned; nothing if they are not numbers.
    #[must_use]
    pub fn from_row(row: &[f64; Self::NUMBERS]) -> Option<Self> {
        let component = |i: usize| Component { share: row[3 * i], mean_m: row[3 * i + 1], sigma_m: row[3 * i + 2] };
        row.iter()
            .all(|number| number.is_finite())
            .then(|| Self { components: std::array::from_fn(component), ln_elsewhere: row[Self::NUMBERS - 1] })
    }

    /// Logarithm of the density at a height, 1/m.
    #[must_use]
    pub fn ln_density(&self, height_m: f64) -> f64 {
        let of_components: f64 =
            self.components.iter().map(|component| component.share * component.density(height_m)).sum();
        ((1.0 - ODD) * of_components + self.ln_elsewhere.exp()).ln()
    }

    /// Their mean, m.
    #[must_use]
    pub fn mean_m(&self) -> f64 {
        self.components.iter().map(|component| component.share * component.mean_m).sum()
    }

    /// What heights say of an object at a height that is known with some variance, m²: the cameras may be higher or lower than they are said to be.
    #[must_use]
    pub fn terms_at(&self, height_m: f64, variance_m2: f64) -> HeightTerms {
        let (mut density, mut slope, mut bend) = (self.ln_elsewhere.exp(), 0.0, 0.0);
        for component in &self.components {
            let component = Component { sigma_m: component.sigma_m.hypot(variance_m2.sqrt()), ..*component };
            let of_component = (1.0 - ODD) * component.share * component.density(height_m);
            let precision = component.sigma_m.powi(-2);
            let pull = (height_m - component.mean_m) * precision;
            density += of_component;
            slope += of_component * pull;
            bend += of_component * (precision - pull * pull);
        }
        let gradient = slope / density;
        // Between two heights, and beyond all, it curves the other way: that tells nothing of how well the height is known.
        let information = (bend / density + gradient * gradient).max(0.0);
        HeightTerms { ln_density: density.ln(), gradient, information }
    }
}

/// What heights say of an object at one of them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeightTerms {
    /// The logarithm of the density, 1/m.
    pub ln_density: f64,
    /// Minus its derivative, 1/m.
    pub gradient: f64,
    /// Minus its second derivative, 1/m²; 0 where that is negative.
    pub information: f64,
}

impl Component {
    fn density(&self, height_m: f64) -> f64 {
        let away = (height_m - self.mean_m) / self.sigma_m;
        (-0.5 * away * away).exp() / (self.sigma_m * (2.0 * PI).sqrt())
    }

    /// What so many objects tell of the height of another one: the variance of a sample is too small, and its mean is not known exactly.
    fn of_another(self, objects: usize) -> Self {
        let n = (self.share * objects as f64).max(2.0);
        Self { sigma_m: self.sigma_m * ((n + 1.0) / (n - 1.0)).sqrt(), ..self }
    }
}

/// The mixture of `count` distributions that makes some heights most likely, begun at their quantiles.
fn components(heights_m: &[f64], count: usize, floor_m: f64) -> [Component; MOST_COMPONENTS] {
    let mut sorted = heights_m.to_vec();
    sorted.sort_by(f64::total_cmp);
    let quantile = |q: f64| sorted[((sorted.len() as f64 * q) as usize).min(sorted.len() - 1)];
    let width = (quantile(0.9) - quantile(0.1)).max(floor_m) / count as f64;
    let mut components =
        [Component { share: 0.0, mean_m: quantile(0.5), sigma_m: width.max(floor_m) }; MOST_COMPONENTS];
    for (i, component) in components.iter_mut().enumerate().take(count) {
        (component.share, component.mean_m) = (1.0 / count as f64, quantile((i as f64 + 0.5) / count as f64));
    }
    for _ in 0..ROUNDS {
        let before = components;
        let total: Vec<f64> = heights_m
            .iter()
            .map(|&height| {
                before.iter().map(|component| component.share * component.density(height)).sum::<f64>()
                    + f64::MIN_POSITIVE
            })
            .collect();
        for (component, old) in components.iter_mut().zip(&before).take(count) {
            let weights: Vec<f64> =
                heights_m.iter().zip(&total).map(|(&height, total)| old.share * old.density(height) / total).collect();
            let sum = weights.iter().sum::<f64>().max(f64::MIN_POSITIVE);
            let mean_m = heights_m.iter().zip(&weights).map(|(height, weight)| height * weight).sum::<f64>() / sum;
            let of_square = |(height, weight): (&f64, &f64)| weight * (height - mean_m).powi(2);
            let variance = heights_m.iter().zip(&weights).map(of_square).sum::<f64>() / sum;
            *component =
                Component { share: sum / heights_m.len() as f64, mean_m, sigma_m: variance.sqrt().max(floor_m) };
        }
        if components.iter().zip(&before).all(|(new, old)| (new.mean_m - old.mean_m).abs() < 1e-3 * floor_m) {
            break;
        }
    }
    components
}

/// How high a point is above the cameras of some rays, m: the nearest count most, roads go up and down. Nothing where nobody knows what is up.
#[must_use]
pub fn height_m(scene: &Scene, up: Option<Vector3<f64>>, votes: &[u32], point: &Vector3<f64>) -> Option<f64> {
    let up = up?;
    let (mut sum, mut all) = (0.0, 0.0);
    for &ray in votes {
        let away = point - scene.ray(ray).center;
        let weight = 1.0 / away.norm_squared();
        sum += weight * away.dot(&up);
        all += weight;
    }
    Some(sum / all).filter(|height| height.is_finite())
}

/// What is up: against where the pictures' columns point, on average, if they agree.
#[must_use]
pub fn up_of(scene: &Scene) -> Option<Vector3<f64>> {
    /// Cosine of 25 degrees, about: cameras that are held askew by more say nothing.
    const AGREEING: f64 = 0.9;
    let sum: Vector3<f64> = scene.views.iter().map(|view| -view.cam_from_world.row(1).transpose()).sum();
    let mean = sum / scene.views.len().max(1) as f64;
    (mean.norm() > AGREEING).then(|| mean.normalize())
}

/// Two level directions at right angles, of which the first is where the first camera looks: they move with the world.
#[must_use]
pub fn level_axes(scene: &Scene, up: &Vector3<f64>) -> [Vector3<f64>; 2] {
    let level = |axis: Vector3<f64>| axis - up * axis.dot(up);
    let axes = scene.views.first().map(|view| [2, 0].map(|row| level(view.cam_from_world.row(row).transpose())));
    let longest = axes.into_iter().flatten().max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()));
    let ahead = longest.unwrap_or_else(|| level(Vector3::x())).normalize();
    [ahead, up.cross(&ahead)]
}

/// The ground within a distance of any camera, m², in cells of a quarter of the distance.
#[must_use]
pub fn ground_m2(scene: &Scene, up: &Vector3<f64>, distance_m: f64) -> f64 {
    /// The 49 cells around one camera cover its circle to 3 %.
    const CELLS: i64 = 4;
    let side_m = distance_m / CELLS as f64;
    let axes = level_axes(scene, up);
    let Some(first) = scene.views.first() else { return 0.0 };
    let place =
        |center: &Vector3<f64>| axes.map(|axis| (axis.dot(&(center - first.center)) / side_m + 0.5).floor() as i64);
    let places: FxHashSet<[i64; 2]> = scene.views.iter().map(|view| place(&view.center)).collect();
    let around: Vec<[i64; 2]> = (-CELLS..=CELLS)
        .flat_map(|x| (-CELLS..=CELLS).map(move |y| [x, y]))
        .filter(|[x, y]| x * x + y * y <= CELLS * CELLS)
        .collect();
    let cells: FxHashSet<[i64; 2]> =
        places.iter().flat_map(|[x, y]| around.iter().map(move |[dx, dy]| [x + dx, y + dy])).collect();
    cells.len() as f64 * side_m * side_m
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Poles of 2 m and masts of 3 m that differ by 0.3 m each.
    fn overlapping() -> Heights {
        let component = |mean_m: f64| Component { share: 0.5, mean_m, sigma_m: 0.3 };
        Heights {
            components: [component(2.0), component(3.0), Component { share: 0.0, ..component(2.0) }],
            ln_elsewhere: -8.0,
        }
    }

    #[test]
    fn terms_are_derivatives_of_the_density() {
        let heights = overlapping();
        for height_m in [1.4, 1.9, 2.2, 2.5, 2.9, 3.3] {
            let at = |height_m: f64| heights.terms_at(height_m, 0.04);
            let (before, here, after) = (at(height_m - 1e-4), at(height_m), at(height_m + 1e-4));
            assert!((here.gradient + (after.ln_density - before.ln_density) / 2e-4).abs() < 1e-5);
            let information = (after.gradient - before.gradient) / 2e-4;
            assert!((here.information - information.max(0.0)).abs() < 1e-4);
        }
    }

    #[test]
    fn between_two_heights_neither_tells_how_high_something_is() {
        let heights = overlapping();
        assert!(heights.terms_at(2.5, 0.0).information < 1e-9);
        assert!(heights.terms_at(2.0, 0.0).information > 0.9 / 0.09);
        // The camera is known no better than that.
        assert!(heights.terms_at(2.0, 1.0).information < 1.0);
    }

    #[test]
    fn few_objects_tell_less_of_another_one() {
        let sigma_m = |count: usize| {
            let heights: Vec<f64> = (0..count).map(|i| 5.0 + 0.1 * f64::from(i as u32 % 2)).collect();
            Heights::learn(&heights, &vec![0.01; count], 50.0).map(|learned| {
                let components = learned.components.iter().filter(|component| component.share > 0.0);
                components.map(|component| component.sigma_m).fold(0.0, f64::max)
            })
        };
        // (n + 1) / (n - 1) times the variance of 0.05 m, or of the floor of 0.01 m where each height is a component.
        assert!(sigma_m(4).is_some_and(|sigma| sigma > 0.01 * 1.7));
        assert!(sigma_m(4) > sigma_m(400));
    }

    #[test]
    fn masts_and_poles_are_told_apart() {
        let heights: Vec<f64> =
            (0..60).map(|i| if i % 3 == 0 { 5.0 } else { 2.0 } + f64::from(i % 7) * 0.1 - 0.3).collect();
        let learned = Heights::learn(&heights, &[0.05; 60], 50.0);
        let means: Vec<f64> = learned
            .iter()
            .flat_map(|learned| learned.components)
            .filter(|component| component.share > 0.0)
            .map(|component| component.mean_m)
            .collect();
        assert_eq!(means.len(), 2);
        assert!((means[0].min(means[1]) - 2.0).abs() < 0.2 && (means[0].max(means[1]) - 5.0).abs() < 0.2);
        let density = |height: f64| learned.as_ref().map_or(0.0, |learned| learned.ln_density(height));
        assert!(density(2.0) > density(3.5) + 3.0 && density(3.5) > density(30.0) - 1e-9);
    }
}
