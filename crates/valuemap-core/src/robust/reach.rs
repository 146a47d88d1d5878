//! Detection rate by distance: the share of the looks at a class that are hits, over that where it is largest.
//!
//! It weighs looks from afar in equation (5) of `docs/method.md`, where a miss says less.

use super::clutter::{BINS, Steps};
use super::energy::Object;
use super::learn::LEAST_LOOKS;
use super::looks::Lookout;
use super::model::Model;

/// Objects that tell, at most: a share of some thousand looks is known to 1 %.
const MOST_OBJECTS: usize = 400;

/// The share of the looks at sure objects that are hits, by distance up to `farthest_m`, over that where it is largest.
#[must_use]
pub fn reach(model: &Model<'_>, lookout: &Lookout, sure: &[&Object], farthest_m: f64) -> Steps {
    let bin = |distance_m: f64| ((distance_m / farthest_m * BINS as f64) as usize).min(BINS - 1);
    let (mut hits, mut looks) = ([0.0_f64; BINS], [0.0_f64; BINS]);
    for object in sure.iter().step_by(sure.len().div_ceil(MOST_OBJECTS).max(1)) {
        for (distance_m, is_hit) in lookout.distances_m(model, &object.fit.point, &object.votes, farthest_m) {
            looks[bin(distance_m)] += 1.0;
            hits[bin(distance_m)] += f64::from(u8::from(is_hit));
        }
    }
    by_distance(&hits, &looks, farthest_m)
}

/// The same of the hits and looks of each bin. From where few looks were, objects are taken to be seen as often as elsewhere: one look that is a hit
/// does not make all others rare.
fn by_distance(hits: &[f64; BINS], looks: &[f64; BINS], farthest_m: f64) -> Steps {
    let share = hits.iter().sum::<f64>() / looks.iter().sum::<f64>();
    let shares: [f64; BINS] = std::array::from_fn(|bin| (hits[bin] + LEAST_LOOKS * share) / (looks[bin] + LEAST_LOOKS));
    let largest = shares.iter().copied().fold(0.0, f64::max);
    if largest > 0.0 { Steps::even(farthest_m, shares.map(|share| share / largest)) } else { Steps::ONE }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_look_that_is_a_hit_does_not_make_all_others_rare() {
        let (mut hits, mut looks) = ([250.0; BINS], [1000.0; BINS]);
        (hits[0], looks[0]) = (1.0, 1.0);
        let reach = by_distance(&hits, &looks, 120.0);
        assert!((reach.at(5.0) - 1.0).abs() < 1e-12 && (0.9..1.0).contains(&reach.at(65.0)), "{}", reach.at(65.0));
    }

    #[test]
    fn objects_are_seen_less_from_where_they_were() {
        let mut hits = [800.0; BINS];
        hits[BINS - 1] = 200.0;
        let reach = by_distance(&hits, &[1000.0; BINS], 120.0);
        assert!((reach.at(119.0) - 0.25).abs() < 0.03 && (reach.at(5.0) - 1.0).abs() < 1e-12);
        assert_eq!(by_distance(&[0.0; BINS], &[0.0; BINS], 120.0), Steps::ONE);
    }
}
