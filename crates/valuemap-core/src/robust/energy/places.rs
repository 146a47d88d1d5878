//! Objects by place, and those of one place together, as they share the pose errors of the images that show them.

use std::cmp::Reverse;

use nalgebra::Vector3;
use rstar::RTree;
use rstar::primitives::GeomWithData;

/// Objects that are estimated together, at most: the cost grows with the square of their number.
const MOST_OBJECTS: usize = 12;

/// Points with their numbers, by place.
pub type ByPlace = RTree<GeomWithData<[f64; 3], usize>>;

/// Some points by place.
#[must_use]
pub fn by_place(points: impl Iterator<Item = Vector3<f64>>) -> ByPlace {
    RTree::bulk_load(points.enumerate().map(|(i, point)| GeomWithData::new(point.into(), i)).collect())
}

/// The objects, of which votes and position are given, around those with the most votes, each object in one place.
#[must_use]
pub fn places(objects: &[(usize, Vector3<f64>)], radius_m: f64) -> Vec<Vec<usize>> {
    let tree = by_place(objects.iter().map(|(_, point)| *point));
    let mut order: Vec<usize> = (0..objects.len()).collect();
    order.sort_by_key(|&i| (Reverse(objects[i].0), i));
    let mut taken = vec![false; objects.len()];
    let mut places = Vec::new();
    for middle in order {
        if taken[middle] {
            continue;
        }
        let near = tree.nearest_neighbor_iter_with_distance_2(objects[middle].1.into());
        let near = near.take_while(|(_, distance2)| *distance2 <= radius_m * radius_m).map(|(near, _)| near.data);
        let mut place: Vec<usize> = near.filter(|&i| !taken[i]).take(MOST_OBJECTS).collect();
        place.sort_unstable();
        for &i in &place {
            taken[i] = true;
        }
        places.push(place);
    }
    places
}
