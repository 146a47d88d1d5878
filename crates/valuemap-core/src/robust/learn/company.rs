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
