//! Detection rate by viewing angle: the shares of hits by the angle to the nearest votes ([`Aspect`]).

use super::reach::{LookedAt, Tally, count, relative};
use crate::robust::model::Model;
use crate::robust::model::aspect::{Aspect, Directions, LEVELS, WIDEST_RAD};
use crate::robust::model::steps::BINS;

/// The shares of hits by angle that the looks at sure objects tell.
#[must_use]
pub fn aspect(model: &Model<'_>, sure: &[LookedAt<'_>]) -> Aspect {
    let [mut within, mut between] = [[Tally::default(); LEVELS]; 2];
    for LookedAt { object, images } in sure {
        let directions = Directions::of(model.scene, &object.fit.point, &object.votes);
        for &(image, is_hit) in images {
            let angles_rad = directions.angles_to_some(&model.scene.views[image as usize], &object.fit.point);
            for (level, [within_rad, between_rad]) in angles_rad.into_iter().enumerate() {
                for (tally, angle_rad) in [(&mut within[level], within_rad), (&mut between[level], between_rad)] {
                    if angle_rad <= WIDEST_RAD {
                        count(tally, angle_rad / WIDEST_RAD, is_hit);
                    }
                }
            }
        }
    }
    let shares = |tally: Tally| relative(&tally).unwrap_or([1.0; BINS]);
    Aspect { within_pass: within.map(shares), between_passes: between.map(shares) }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::super::reach::looked_at;
    use super::*;
    use crate::robust::energy::looks::Lookout;
    use crate::robust::model::aspect::level;
    use crate::street;

    #[test]
    fn what_is_seen_from_one_side_of_two_passes_is_told_by_the_angle_to_the_other() {
        let at = Vector3::new(40.0, 8.0, 3.0);
        let scene = street::joined(vec![street::street(15, 2.0, &[at], &[[0.0; 2]]); 2]);
        let model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
        // Of the first pass the first half has votes.
        let rays = scene.usable_rays();
        let votes: Vec<u32> = rays.iter().copied().filter(|&ray| !(7..15).contains(&ray)).collect();
        let directions = Directions::of(&scene, &at, &votes);
        let of = |image: usize, count: usize| directions.angles_to_some(&scene.views[image], &at)[level(count)];
        // The other pass was at the same places; of the own pass the nearest vote but its own is one image away.
        let next_rad = 2.0 * 8.0 / (40.0_f64.powi(2) + 8.0 * 8.0);
        assert!(of(3, 1)[1] < 1e-6 && (0.3..3.0).contains(&(of(3, 4)[0] / next_rad)), "{:?}", of(3, 4));
        assert!(of(3, 16)[0] > WIDEST_RAD && of(3, 4)[1] > WIDEST_RAD);
        assert!(of(14, 4)[0] > of(8, 4)[0] && of(14, 4)[0] > 4.0 * next_rad);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let object = crate::robust::energy::object(&model, &lookout, votes, at);
        let learned =
            object.map_or(Aspect::ONE, |object| aspect(&model, &looked_at(&model, &lookout, &[&object], 50.0)));
        let falls = |shares: &[f64; BINS]| shares.iter().any(|share| *share < 0.9);
        assert!(falls(&learned.within_pass[2]) && !falls(&learned.within_pass[5]), "{learned:?}");
    }
}
