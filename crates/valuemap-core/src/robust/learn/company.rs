//! How near the next sure object of the class is: equation (7) of `docs/method.md`.
//!
//! Lights, signs and ramps stand together at crossings. The ratio is learned from the map: how often a sure object has another one within a distance, over
//! how often any seen place has one.

use nalgebra::Vector3;
use rstar::RTree;
use rstar::primitives::GeomWithData;

use crate::robust::energy::{Object, TELLING_VOTES};
use crate::robust::model::heights::level_axes;
use crate::robust::model::steps::{Steps, score_ratio};
use crate::robust::model::{ClassModel, Model};

/// Cameras of which the surroundings tell, at most. With 32 places each, bins have some thousand places; more cost time.
const MOST_VIEWS: usize = 1_000;
/// Places around a camera: rings of equal area, and directions. Few are enough, as the places around other cameras lie between.
const RINGS: usize = 4;
const DIRECTIONS: usize = 8;

/// The sure objects of a class.
pub struct Sure(RTree<GeomWithData<[f64; 3], usize>>);

impl Sure {
    /// Those among some objects.
    #[must_use]
    pub fn of(objects: &[Object], class: u32) -> Self {
        let is_sure = |(_, object): &(usize, &Object)| object.class == class && object.votes.len() >= TELLING_VOTES;
        let places = objects.iter().enumerate().filter(is_sure);
        Self(RTree::bulk_load(places.map(|(row, object)| GeomWithData::new(object.fit.point.into(), row)).collect()))
    }

    /// Those of each class.
    #[must_use]
    pub fn of_classes(model: &Model<'_>, objects: &[Object]) -> Vec<Self> {
        (0..model.classes.len() as u32).map(|class| Self::of(objects, class)).collect()
    }

    /// Minus the distance to the nearest one but one, m; not a number where there is none.
    #[must_use]
    pub fn nearness(&self, place: &Vector3<f64>, but: Option<usize>) -> f64 {
        let mut near = self.0.nearest_neighbor_iter_with_distance_2((*place).into());
        near.find(|(object, _)| Some(object.data) != but).map_or(f64::NAN, |(_, square)| -square.sqrt())
    }

    /// Minus the distance to the nearest one that an image shows beside an object, m; not a number where there is none but itself (`row`, if it has one).
    ///
    /// The nearest of all may be the same thing once more. What is farther than images show stands apart, whether they do or not.
    #[must_use]
    pub fn nearness_beside(&self, model: &Model<'_>, objects: &[Object], object: &Object, row: Option<usize>) -> f64 {
        let most_m = 2.0 * model.classes[object.class as usize].farthest_m;
        let mut near = self.0.nearest_neighbor_iter_with_distance_2(object.fit.point.into());
        let counts = |other: usize, square: f64| {
            Some(other) != row && (square > most_m * most_m || object.is_seen_beside(model.scene, &objects[other]))
        };
        near.find(|&(other, square)| counts(other.data, square)).map_or(f64::NAN, |(_, square)| -square.sqrt())
    }
}

/// How much denser, in logarithms, objects of a class are near others, by minus the distance, m; 0 everywhere of too few, and where nobody knows what
/// is up.
#[must_use]
pub fn company(model: &Model<'_>, objects: &[Object], learned: &ClassModel, class: u32) -> Steps {
    let (Some(up), Some(heights)) = (model.up, learned.heights) else { return Steps::NONE };
    let sure = Sure::of(objects, class);
    let of_objects: Vec<f64> =
        sure.0.iter().map(|object| sure.nearness(&Vector3::from(*object.geom()), Some(object.data))).collect();
    let [ahead, aside] = level_axes(model.scene, &up);
    let views = &model.scene.views;
    let mut of_ground = Vec::new();
    for view in views.iter().step_by(views.len().div_ceil(MOST_VIEWS).max(1)) {
        for ring in 0..RINGS {
            let distance_m = learned.farthest_m * ((ring as f64 + 0.5) / RINGS as f64).sqrt();
            for direction in 0..DIRECTIONS {
                let (sin, cos) = (std::f64::consts::TAU * direction as f64 / DIRECTIONS as f64).sin_cos();
                let place = view.center + up * heights.mean_m() + (ahead * cos + aside * sin) * distance_m;
                of_ground.push(sure.nearness(&place, None));
            }
        }
    }
    score_ratio(&of_objects, &of_ground)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robust::energy::anywhere;
    use crate::robust::energy::seen::Seen;
    use crate::street::{NOISE, SETTINGS, street};

    #[test]
    fn company_is_what_an_image_shows_beside_an_object() {
        let signs: Vec<Vector3<f64>> = [12.0, 13.0, 20.0].map(|x| Vector3::new(x, 4.0, 3.0)).into();
        let scene = street(12, 1.0, &signs, &[[0.0; 2]]);
        let model = Model::new(&scene, &NOISE, &SETTINGS);
        let of = |sign: usize, images: std::ops::Range<u32>| {
            let shows = |ray: &u32| {
                images.contains(&scene.image_of(*ray)) && scene.ray(*ray).project(&signs[sign]).xy().norm() < 1e-6
            };
            let votes: Vec<u32> = (0..scene.rays.rays.len() as u32).filter(shows).collect();
            let mut object = anywhere(votes.len(), Seen::default(), -20.0);
            (object.votes, object.fit.point) = (votes, signs[sign]);
            object
        };
        // The second one is seen once the first one is not.
        let objects = [of(0, 0..4), of(1, 4..8), of(2, 0..8)];
        let sure = Sure::of(&objects, 0);
        let nearness = |row: usize| sure.nearness_beside(&model, &objects, &objects[row], Some(row));
        let is = |nearness: f64, away_m: f64| assert!((nearness + away_m).abs() < 1e-9, "{nearness}");
        is(nearness(0), 8.0);
        is(nearness(1), 7.0);
        is(sure.nearness(&signs[0], Some(0)), 1.0);
        // Nothing shows them together as well, and it is farther than images show.
        let mut far = of(1, 8..9);
        far.fit.point.x += 1000.0;
        is(sure.nearness_beside(&model, &objects, &far, None), (far.fit.point - signs[2]).norm());
    }
}
