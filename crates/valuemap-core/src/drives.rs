//! Drives: where the cameras of images are, where a vehicle comes back to, and where viewpoints begin along its way.

use rustc_hash::FxHashMap;

/// The camera centre of an image in metres in the world, -Rᵀt, by its quaternion (w, x, y, z) and translation.
#[must_use]
pub fn camera_center(&[w, x, y, z]: &[f64; 4], &[a, b, c]: &[f64; 3]) -> [f64; 3] {
    let (xx, yy, zz, xy, xz, yz, wx, wy, wz) = (x * x, y * y, z * z, x * y, x * z, y * z, w * x, w * y, w * z);
    [
        -((1.0 - 2.0 * (yy + zz)) * a + 2.0 * (xy + wz) * b + 2.0 * (xz - wy) * c),
        -(2.0 * (xy - wz) * a + (1.0 - 2.0 * (xx + zz)) * b + 2.0 * (yz + wx) * c),
        -(2.0 * (xz + wy) * a + 2.0 * (yz - wx) * b + (1.0 - 2.0 * (xx + yy)) * c),
    ]
}

/// The exposures of drives, one drive after the other, each in driving order.
pub struct Way<'a> {
    /// Where each was taken, m.
    pub place_m: &'a [[f64; 3]],
    /// The drive of each.
    pub drive: &'a [i64],
    /// How far the drive had come, m.
    pub driven_m: &'a [f64],
    /// What is nearer is the same place, m; NaN where nobody asks for revisits.
    pub near_m: &'a [f64],
    /// Who drove so far since had left, m.
    pub away_m: &'a [f64],
    /// The two axes of the ground.
    pub ground: [usize; 2],
}

/// Places of a drive by the cells of one grid: the cell that it is in, and where it left each other one.
#[derive(Default)]
struct Visited {
    cell: Option<[i64; 2]>,
    left_at: FxHashMap<[i64; 2], usize>,
}

impl Visited {
    /// Go on from the exposure `before` to one in a cell; where the drive was in it once already, say where it left.
    fn enter(&mut self, cell: [i64; 2], before: usize) -> Option<usize> {
        if self.cell == Some(cell) {
            return None;
        }
        if let Some(left) = self.cell.replace(cell) {
            self.left_at.insert(left, before);
        }
        self.left_at.get(&cell).copied()
    }
}

/// Where drives come back to where they have been, having left: what follows is a drive of its own.
///
/// Cells are twice as wide as what is the same place, in four grids, each shifted by half a cell, so that any two near
/// places share one.
#[must_use]
pub fn revisits(way: &Way) -> Vec<bool> {
    const SHIFTS: [[f64; 2]; 4] = [[0.0, 0.0], [0.0, 0.5], [0.5, 0.0], [0.5, 0.5]];
    let mut revisits = vec![false; way.place_m.len()];
    let mut grids: [Visited; 4] = Default::default();
    let (mut before, mut start) = (None, 0);
    for here in (0..way.place_m.len()).filter(|&row| !way.near_m[row].is_nan()) {
        if before.is_some_and(|row: usize| way.drive[row] != way.drive[here]) {
            grids = Default::default();
        }
        let [x, y] = way.ground.map(|axis| way.place_m[here][axis] / (2.0 * way.near_m[here]));
        let mut last = None;
        for ([along, across], grid) in SHIFTS.iter().zip(&mut grids) {
            let cell = [(x + along).floor() as i64, (y + across).floor() as i64];
            let there = grid.enter(cell, before.unwrap_or(here)).filter(|&there| {
                way.driven_m[here] - way.driven_m[there] >= way.away_m[here]
                    && distance(&way.place_m[here], &way.place_m[there]) <= 4.0 * way.near_m[here]
            });
            last = last.max(there);
        }
        if last.is_some_and(|there| there >= start) {
            revisits[here] = true;
            start = here;
        }
        before = Some(here);
    }
    revisits
}

/// Where viewpoints begin along drives: with each, and where it has moved by more than a step since the last one.
#[must_use]
pub fn viewpoint_openings(place_m: &[[f64; 3]], begins: &[bool], step_m: f64) -> Vec<bool> {
    let mut start = [0.0; 3];
    let opens = |(place, &begins): (&[f64; 3], &bool)| {
        let opens = begins || distance(place, &start) > step_m;
        if opens {
            start = *place;
        }
        opens
    };
    place_m.iter().zip(begins).map(opens).collect()
}

fn distance(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn along(x: &[f64]) -> Vec<[f64; 3]> {
        x.iter().map(|&x| [x, 0.0, 0.0]).collect()
    }

    /// Steps of 1 m there and back; what is nearer than 1 m is the same place, and who drove 3 m had left it.
    fn revisits_of(x: &[f64], drive: &[i64]) -> Vec<usize> {
        let place_m = along(x);
        let driven_m: Vec<f64> = (0..x.len()).map(|row| row as f64).collect();
        let (near_m, away_m) = (vec![1.0; x.len()], vec![3.0; x.len()]);
        let way =
            Way { place_m: &place_m, drive, driven_m: &driven_m, near_m: &near_m, away_m: &away_m, ground: [0, 1] };
        revisits(&way).iter().enumerate().filter(|(_, is)| **is).map(|(row, _)| row).collect()
    }

    #[test]
    fn who_comes_back_drives_anew() {
        assert_eq!(revisits_of(&[0.0, 3.0, 6.0, 9.0, 6.1, 3.1, 0.1], &[0; 7]), [5]);
        assert_eq!(revisits_of(&[0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 18.0], &[0; 7]), []);
    }

    #[test]
    fn another_drive_may_be_anywhere() {
        assert_eq!(revisits_of(&[0.0, 3.0, 6.0, 9.0, 6.1, 3.1, 0.1], &[0, 0, 0, 0, 1, 1, 1]), []);
    }

    #[test]
    fn viewpoints_begin_where_the_last_is_a_step_away() {
        let opens =
            viewpoint_openings(&along(&[0.0, 0.6, 1.2, 1.8, 2.4, 2.4]), &[true, false, false, false, false, true], 1.0);
        assert_eq!(opens, [true, false, true, false, true, true]);
        assert!(viewpoint_openings(&[], &[], 1.0).is_empty());
    }

    #[test]
    fn a_camera_that_is_not_turned_is_at_its_translation_backwards() {
        let center = camera_center(&[1.0, 0.0, 0.0, 0.0], &[1.0, -2.0, 3.0]);
        assert!(distance(&center, &[-1.0, 2.0, -3.0]) < 1e-15);
    }
}
