//! Merging: labels of different clusters that stand for one object become one.

use nalgebra::Vector3;
use rstar::RTree;
use rstar::primitives::GeomWithData;

use super::triangulate;
use super::vote::Candidate;
use crate::ray::Rays;

/// Merge candidates of one class and of different clusters that are closer than `radius`, the closest pair first; the
/// position is refined over the union of the voters before distances are looked at again.
///
/// Candidates of one cluster were found to be different objects there and stay apart. Returns the labels ordered
/// by their first voter.
#[must_use]
pub fn merge(rays: &Rays, candidates: Vec<Candidate>, radius: f64) -> Vec<Candidate> {
    let mut labels = candidates;
    let mut fresh: Vec<usize> = (0..labels.len()).collect();
    let mut alive = vec![true; labels.len()];
    // Only a label that moved can have new neighbours, so each round looks at the labels of the last one.
    while !fresh.is_empty() {
        let mut pairs = near_pairs(&labels, &alive, &fresh, rays, radius);
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        let mut moved = vec![false; labels.len()];
        fresh.clear();
        for (_, a, b) in pairs {
            if moved[a] || moved[b] {
                continue;
            }
            moved[a] = true;
            moved[b] = true;
            alive[b] = false;
            labels[a] = union(&labels[a], &labels[b], rays);
            fresh.push(a);
        }
    }
    let mut kept: Vec<Candidate> =
        labels.into_iter().zip(alive).filter_map(|(label, alive)| alive.then_some(label)).collect();
    kept.sort_by_key(|label| label.voters[0]);
    kept
}

/// Pairs `(squared distance, a, b)`, `a < b`, of which at least one is fresh, that may become one.
fn near_pairs(
    labels: &[Candidate],
    alive: &[bool],
    fresh: &[usize],
    rays: &Rays,
    radius: f64,
) -> Vec<(f64, usize, usize)> {
    let class = |label: &Candidate| rays.class[label.voters[0] as usize];
    let points = (0..labels.len())
        .filter(|&i| alive[i])
        .map(|i| GeomWithData::new([labels[i].point.x, labels[i].point.y, labels[i].point.z], i))
        .collect();
    let tree: RTree<GeomWithData<[f64; 3], usize>> = RTree::bulk_load(points);
    let mut is_fresh = vec![false; labels.len()];
    for &i in fresh {
        is_fresh[i] = true;
    }
    let mut pairs = Vec::new();
    for &i in fresh {
        let at = labels[i].point;
        for near in tree.locate_within_distance([at.x, at.y, at.z], radius * radius) {
            let j = near.data;
            let distance2 = (labels[j].point - at).norm_squared();
            let once = j != i && (i < j || !is_fresh[j]);
            if once
                && distance2 < radius * radius
                && class(&labels[i]) == class(&labels[j])
                && disjoint(&labels[i].clusters, &labels[j].clusters)
            {
                pairs.push((distance2, i.min(j), i.max(j)));
            }
        }
    }
    pairs
}

fn union(a: &Candidate, b: &Candidate, rays: &Rays) -> Candidate {
    let voters = sorted_union(&a.voters, &b.voters);
    let weight = a.voters.len() as f64 / (a.voters.len() + b.voters.len()) as f64;
    let start: Vector3<f64> = a.point * weight + b.point * (1.0 - weight);
    let supporters = voters.iter().map(|&ray| &rays.rays[ray as usize]);
    let point = triangulate::refine(&supporters, start).unwrap_or(start);
    Candidate { point, clusters: sorted_union(&a.clusters, &b.clusters), voters }
}

/// Clusters share no image, so voters of two candidates never collide.
fn sorted_union(a: &[u32], b: &[u32]) -> Vec<u32> {
    let mut all = [a, b].concat();
    all.sort_unstable();
    all.dedup();
    all
}

fn disjoint(a: &[u32], b: &[u32]) -> bool {
    a.iter().all(|x| b.binary_search(x).is_err())
}
