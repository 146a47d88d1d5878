//! Clusters: the paper's unit of independent work.

use rstar::RTree;
use rstar::primitives::GeomWithData;

/// Split images into clusters: each seed takes all images not yet taken closer than `radius` to it, itself included.
///
/// `centers` are camera centres in metres, ordered by image id; seeds are tried in that order, so that the result
/// depends neither on the order of rows nor on the frame. Returns the cluster of each image, numbered from 0.
#[must_use]
pub fn partition(centers: &[[f64; 3]], radius: f64) -> Vec<u32> {
    const FREE: u32 = u32::MAX;
    let points = centers.iter().enumerate().map(|(i, &center)| GeomWithData::new(center, i)).collect();
    let tree: RTree<GeomWithData<[f64; 3], usize>> = RTree::bulk_load(points);
    let mut cluster = vec![FREE; centers.len()];
    let mut next = 0;
    for (seed, &center) in centers.iter().enumerate() {
        if cluster[seed] != FREE {
            continue;
        }
        for neighbor in tree.locate_within_distance(center, radius * radius) {
            let taken = &mut cluster[neighbor.data];
            if *taken == FREE && squared_distance(&centers[neighbor.data], &center) < radius * radius {
                *taken = next;
            }
        }
        cluster[seed] = next;
        next += 1;
    }
    cluster
}

fn squared_distance(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_take_free_images_strictly_within_the_radius() {
        let line: Vec<[f64; 3]> = [0.0, 49.0, 50.0, 99.0, 100.0, 200.0].iter().map(|&x| [x, 0.0, 0.0]).collect();
        assert_eq!(partition(&line, 50.0), [0, 0, 1, 1, 2, 3]);
    }

    #[test]
    fn no_images_no_clusters() {
        assert!(partition(&[], 50.0).is_empty());
    }
}
