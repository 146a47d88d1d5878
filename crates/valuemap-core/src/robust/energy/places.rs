//! Objects of one place, which share the pose errors of the images that show them.

use super::{Object, by_place};

/// Objects that are estimated together, at most: the cost grows with the square of their number.
pub const MOST_OBJECTS: usize = 12;

/// The objects around those with the most votes, each object in one place.
#[must_use]
pub fn places(objects: &[Object], radius_m: f64) -> Vec<Vec<usize>> {
    let tree = by_place(objects);
    let mut order: Vec<usize> = (0..objects.len()).collect();
    order.sort_by_key(|&i| (std::cmp::Reverse(objects[i].votes.len()), i));
    let mut taken = vec![false; objects.len()];
    let mut places = Vec::new();
    for middle in order {
        if taken[middle] {
            continue;
        }
        let near = tree.nearest_neighbor_iter_with_distance_2(objects[middle].fit.point.into());
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
