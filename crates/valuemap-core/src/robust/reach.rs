//! Detection rates by distance and by viewing angle: the share of the looks at a class that are hits, over that where it is largest.
//!
//! They weigh looks in equation (5) of `docs/method.md`: a miss from afar, or from where an object turns its back, says less.

use super::clutter::{BINS, Steps};
use super::energy::Object;
use super::learn::LEAST_LOOKS;
use super::looks::{Lookout, WIDEST_RAD};
use super::model::Model;

/// Objects that tell, at most: a share of some thousand looks is known to 1 %.
const MOST_OBJECTS: usize = 400;

/// How often a class is detected from where it is seen less, over where it is seen most.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Aspect {
    /// By the angle to the nearest vote of the same pass, rad.
    pub within_pass: Steps,
    /// By the angle to the nearest vote of another pass, rad, where the pass itself has none near.
    pub between_passes: Steps,
}

impl Aspect {
    /// Seen from everywhere.
    pub const ONE: Self = Self { within_pass: Steps::ONE, between_passes: Steps::ONE };
}

/// The share of the looks at sure objects that are hits, by distance up to `farthest_m` and by angle to the nearest other vote, over that where each is
/// largest.
#[must_use]
pub fn reach(model: &Model<'_>, lookout: &Lookout, sure: &[&Object], farthest_m: f64) -> (Steps, Aspect) {
    let [mut by_distance, mut within, mut between] = [[[0.0_f64; 2]; BINS]; 3];
    for object in sure.iter().step_by(sure.len().div_ceil(MOST_OBJECTS).max(1)) {
        for sight in lookout.seen(model, &object.fit.point, &object.votes, farthest_m) {
            let count = |of_bins: &mut [[f64; 2]; BINS], part: f64| {
                let of_bin = &mut of_bins[((part * BINS as f64) as usize).min(BINS - 1)];
                *of_bin = [of_bin[0] + f64::from(u8::from(sight.is_hit)), of_bin[1] + 1.0];
            };
            count(&mut by_distance, sight.distance_m / farthest_m);
            if sight.within_rad <= WIDEST_RAD {
                count(&mut within, sight.within_rad / WIDEST_RAD);
            }
            if sight.between_rad <= WIDEST_RAD {
                count(&mut between, sight.between_rad / WIDEST_RAD);
            }
        }
    }
    let aspect = Aspect { within_pass: relative(&within, WIDEST_RAD), between_passes: relative(&between, WIDEST_RAD) };
    (relative(&by_distance, farthest_m), aspect)
}

/// The same of the hits and looks of each bin. From where few looks were, objects are taken to be seen as often as elsewhere: one look that is a hit
/// does not make all others rare.
fn relative(of_bins: &[[f64; 2]; BINS], most: f64) -> Steps {
    let [hits, looks] = of_bins.iter().fold([0.0; 2], |sum, of_bin| [sum[0] + of_bin[0], sum[1] + of_bin[1]]);
    let shares = of_bins.map(|[of_hits, of_looks]| (of_hits + LEAST_LOOKS * hits / looks) / (of_looks + LEAST_LOOKS));
    let largest = shares.iter().copied().fold(0.0, f64::max);
    if largest > 0.0 { Steps::even(most, shares.map(|share| share / largest)) } else { Steps::ONE }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_look_that_is_a_hit_does_not_make_all_others_rare() {
        let mut of_bins = [[250.0, 1000.0]; BINS];
        of_bins[0] = [1.0, 1.0];
        let reach = relative(&of_bins, 120.0);
        assert!((reach.at(5.0) - 1.0).abs() < 1e-12 && (0.9..1.0).contains(&reach.at(65.0)), "{}", reach.at(65.0));
    }

    #[test]
    fn objects_are_seen_less_from_where_they_were() {
        let mut of_bins = [[800.0, 1000.0]; BINS];
        of_bins[BINS - 1] = [200.0, 1000.0];
        let reach = relative(&of_bins, 120.0);
        assert!((reach.at(119.0) - 0.25).abs() < 0.03 && (reach.at(5.0) - 1.0).abs() < 1e-12);
        assert_eq!(relative(&[[0.0; 2]; BINS], 120.0), Steps::ONE);
    }
}
