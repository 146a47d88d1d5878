//! What the voters of a label see: how far off they are, how large an object they show, from how far apart.

use nalgebra::Vector3;

use crate::ray::Ray;

/// Beyond this number of directions, only those farthest from their mean are compared with each other.
const MAX_DIRECTIONS: usize = 64;

/// The view of a point along one ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sight {
    /// Reprojection error, px.
    pub residual_px: f64,
    /// Metres at the point that a pixel spans, horizontally and vertically in the picture.
    pub metres_per_px: [f64; 2],
}

/// How a ray sees a point.
#[must_use]
pub fn sight(ray: &Ray, point: &Vector3<f64>) -> Sight {
    let projected = ray.project(point);
    let pixels_per_unit2 = ray.pixels_per_unit2_of_axes();
    Sight {
        residual_px: (projected.x / projected.z).hypot(projected.y / projected.z),
        metres_per_px: pixels_per_unit2.map(|pixels2| projected.z / pixels2.sqrt()),
    }
}

/// The largest angle at which two cameras see a point, rad: exact up to 64 cameras; beyond, among the 64 directions that
/// are farthest from the mean direction.
#[must_use]
pub fn max_angle<'a>(rays: impl Iterator<Item = &'a Ray>, point: &Vector3<f64>) -> f64 {
    let mut directions: Vec<Vector3<f64>> = rays.map(|ray| (point - ray.center).normalize()).collect();
    if directions.len() > MAX_DIRECTIONS {
        let mean = directions.iter().sum::<Vector3<f64>>() / directions.len() as f64;
        let far = |direction: &Vector3<f64>| (direction - mean).norm_squared();
        directions.select_nth_unstable_by(MAX_DIRECTIONS, |a, b| far(b).total_cmp(&far(a)));
        directions.truncate(MAX_DIRECTIONS);
    }
    let mut chord2 = 0.0_f64;
    for (i, a) in directions.iter().enumerate() {
        for b in &directions[..i] {
            chord2 = chord2.max((a - b).norm_squared());
        }
    }
    2.0 * (0.5 * chord2.sqrt()).min(1.0).asin()
}

/// The median, of an even number the mean of the two in the middle; NaN of nothing. The order of the values changes.
#[must_use]
pub fn median(values: &mut [f64]) -> f64 {
    let Some(last) = values.len().checked_sub(1) else { return f64::NAN };
    let (below, &mut upper, _) = values.select_nth_unstable_by(values.len() / 2, f64::total_cmp);
    let lower = if last % 2 == 1 { below.iter().copied().max_by(f64::total_cmp) } else { None };
    0.5 * (lower.unwrap_or(upper) + upper)
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix3;
    use proptest::prelude::*;

    use super::*;

    /// A camera that looks along z, with another focal length on each axis, turned by no angle.
    fn camera(focal_px: [f64; 2], center: Vector3<f64>, seen: &Vector3<f64>) -> Ray {
        let away = seen - center;
        let (x, y) = (focal_px[0] * away.x / away.z, focal_px[1] * away.y / away.z);
        let residual_from_world = Matrix3::new(focal_px[0], 0.0, -x, 0.0, focal_px[1], -y, 0.0, 0.0, 1.0);
        Ray { residual_from_world, center, direction: away.normalize() }
    }

    #[test]
    fn a_ray_sees_pixels_and_metres() {
        let ray = camera([500.0, 400.0], Vector3::new(1.0, 2.0, 3.0), &Vector3::new(1.0, 2.0, 13.0));
        let seen = sight(&ray, &Vector3::new(1.3, 2.5, 13.0));
        assert!((seen.residual_px - 15.0_f64.hypot(20.0)).abs() < 1e-9);
        assert!((seen.metres_per_px[0] - 10.0 / 500.0).abs() < 1e-12);
        assert!((seen.metres_per_px[1] - 10.0 / 400.0).abs() < 1e-12);
    }

    #[test]
    fn cameras_around_a_point_are_half_a_turn_apart() {
        let around = |count: usize| {
            let turn = move |i: usize| std::f64::consts::TAU * i as f64 / count as f64;
            (0..count).map(move |i| Vector3::new(turn(i).cos(), turn(i).sin(), 0.0) * (1.0 + i as f64))
        };
        for count in [2, 4, 64, 66, 200] {
            let rays: Vec<Ray> = around(count).map(|center| camera([1.0; 2], center, &Vector3::z())).collect();
            assert!((max_angle(rays.iter(), &Vector3::zeros()) - std::f64::consts::PI).abs() < 1e-6);
        }
        let one = camera([1.0; 2], Vector3::x(), &Vector3::z());
        assert!(max_angle([&one].into_iter(), &Vector3::zeros()).abs() < 1e-12);
    }

    proptest! {
        #[test]
        fn the_median_is_in_the_middle_of_the_sorted_values(mut values in prop::collection::vec(-1e6..1e6, 1..30_usize)) {
            let found = median(&mut values);
            values.sort_by(f64::total_cmp);
            let middle = [(values.len() - 1) / 2, values.len() / 2];
            prop_assert!((found - 0.5 * (values[middle[0]] + values[middle[1]])).abs() < 1e-9);
        }
    }
}
