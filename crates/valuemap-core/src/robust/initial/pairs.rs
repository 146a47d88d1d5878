//! Pairs of labels near each other, disjoint and the nearest first, and their replacement by what is better.

use rayon::prelude::*;

use super::label::{Known, Label, by_place, first_voter};

/// Pairs of labels within a distance of each other, the one with the lower number first, in no order.
#[must_use]
pub fn near_pairs(labels: &[Label], distance_m: f64) -> Vec<(usize, usize)> {
    let tree = by_place(labels);
    let of_label = |(a, label): (usize, &Label)| {
        let near = tree.locate_within_distance(label.estimate.point.into(), distance_m * distance_m);
        near.map(|near| near.data).filter(|&b| b > a).map(|b| (a, b)).collect::<Vec<_>>()
    };
    labels.par_iter().enumerate().flat_map_iter(of_label).collect()
}

/// Disjoint pairs of labels within a distance of each other that may be paired, the nearest first.
#[must_use]
pub fn nearest_pairs(
    labels: &[Label],
    distance_m: f64,
    may_pair: impl Fn(&Label, &Label) -> bool + Sync,
) -> Vec<(usize, usize)> {
    let apart = |(a, b): (usize, usize)| {
        let (first, second) = (&labels[a], &labels[b]);
        may_pair(first, second).then(|| ((second.estimate.point - first.estimate.point).norm(), a, b))
    };
    disjoint(near_pairs(labels, distance_m).into_par_iter().filter_map(apart).collect())
}

/// Of pairs with their distances those of which no label is in a nearer one, the nearest first.
#[must_use]
pub fn disjoint(mut pairs: Vec<(f64, usize, usize)>) -> Vec<(usize, usize)> {
    pairs.sort_by(|x, y| x.0.total_cmp(&y.0).then((x.1, x.2).cmp(&(y.1, y.2))));
    let labels = pairs.iter().map(|(_, _, b)| b + 1).max().unwrap_or(0);
    let mut taken = vec![false; labels];
    let mut apart = Vec::new();
    for (_, a, b) in pairs {
        if !taken[a] && !taken[b] {
            (taken[a], taken[b]) = (true, true);
            apart.push((a, b));
        }
    }
    apart
}

/// All labels, some disjoint pairs replaced; `keep` notes that a pair was not, with what the second one was.
#[must_use]
pub fn replaced(
    mut labels: Vec<Label>,
    pairs: &[(usize, usize)],
    new: Vec<Option<Vec<Label>>>,
    keep: impl Fn(&mut Known, u64),
) -> Vec<Label> {
    let mut is_replaced = vec![false; labels.len()];
    let mut replacing = Vec::new();
    for (&(a, b), new) in pairs.iter().zip(new) {
        if let Some(new) = new {
            (is_replaced[a], is_replaced[b]) = (true, true);
            replacing.extend(new);
        } else {
            let second = labels[b].identity();
            keep(&mut labels[a].known, second);
        }
    }
    let kept = labels.into_iter().zip(is_replaced).filter(|(_, is_replaced)| !is_replaced).map(|(label, _)| label);
    let mut labels: Vec<Label> = kept.chain(replacing).collect();
    labels.sort_by_cached_key(first_voter);
    labels
}
