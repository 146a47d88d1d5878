//! How far objects of a class are detected: the share of the looks that are hits, by distance.

use super::clutter::{BINS, Steps};
use super::energy::Object;
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
    // Rule of succession, from certainty: what was never looked at from there is expected to be seen.
    let shares: [f64; BINS] = std::array::from_fn(|bin| (hits[bin] + 1.0) / (looks[bin] + 1.0));
    let largest = (0..BINS).filter(|&bin| looks[bin] > 0.0).map(|bin| shares[bin]).fold(0.0, f64::max);
    if largest > 0.0 { Steps::even(farthest_m, shares.map(|share| (share / largest).min(1.0))) } else { Steps::ONE }
}
