//! The ballot: which rays each hypothesis projects onto, as one row of bits a hypothesis.
//!
//! Rays are laid out image by image, so that the votes of a row (images with at least one ray in the gate) are
//! counted with word arithmetic, and taking voters away is one `and-not` a word: the greedy selection never
//! projects anything again.

use nalgebra::Vector3;

use crate::kernel::{Gate, Gates, LANES, ones};
use crate::progress::{Halt, Progress};
use crate::ray::Ray;

const MAX_BYTES: usize = 8 << 30;

/// Bits of all hypotheses, with the layout of rays on bits.
pub struct Ballot {
    words: usize,
    rows: Vec<u64>,
    layout: Layout,
}

/// Where each ray's bit is, and which bits belong to one image.
struct Layout {
    bit_of_ray: Vec<u32>,
    ray_of_bit: Vec<u32>,
    /// Per word: the last bit of each image's run, and all other bits of the runs.
    last: Vec<u64>,
    body: Vec<u64>,
    /// Images with more rays than a word has bits own whole words: (first word, number of words).
    wide: Vec<(usize, usize)>,
}

impl Ballot {
    /// Project every point into every image: the bits of the rays that are closer than `gate_px`.
    ///
    /// `image` is the image of each ray and must not decrease.
    ///
    /// # Errors
    /// [`Halt::Cancelled`] when `progress` says so, [`Halt::TooLarge`] for a ballot of more than 8 GiB.
    pub fn cast(
        points: &[Vector3<f64>],
        rays: &[Ray],
        image: &[u32],
        gate_px: f64,
        progress: &Progress,
    ) -> Result<Self, Halt> {
        const BATCH: usize = 256;
        let layout = Layout::new(image);
        let gate = Gate { radius_px: gate_px, floor_m2: 0.0 };
        let gates = Gates::new(rays.iter().zip(&layout.bit_of_ray).map(|(ray, &bit)| (bit, ray, gate)));
        let words = gates.words();
        if points.len().saturating_mul(words * size_of::<u64>()) > MAX_BYTES {
            return Err(Halt::TooLarge { rays: rays.len(), hypotheses: points.len() });
        }
        let mut rows = vec![0; points.len() * words];
        let mut sure = vec![0; BATCH * words];
        for (points, rows) in points.chunks(BATCH).zip(rows.chunks_mut((BATCH * words).max(1))) {
            progress.check()?;
            let sure = &mut sure[..rows.len()];
            gates.test(points, rows, sure);
            for (point, (row, sure)) in points.iter().zip(rows.chunks_mut(words).zip(sure.chunks(words))) {
                for (first, (maybe, sure)) in (0..).step_by(LANES).zip(row.iter_mut().zip(sure)) {
                    for bit in ones(*maybe & !*sure) {
                        let ray = &rays[layout.ray_of_bit[first + bit as usize] as usize];
                        if !gate.holds(&ray.project(point)) {
                            *maybe &= !(1 << bit);
                        }
                    }
                }
            }
        }
        Ok(Self { words, rows, layout })
    }

    /// Images with at least one ray in the gate of a hypothesis.
    #[must_use]
    pub fn votes(&self, hypothesis: usize) -> u32 {
        let row = self.row(hypothesis);
        let layout = &self.layout;
        let runs: u32 = row
            .iter()
            .zip(layout.last.iter().zip(&layout.body))
            // Adding a run's body to itself-or-more carries into its last bit if any bit of the body is set.
            .map(|(&bits, (&last, &body))| ((((bits & body) + body) | bits) & last).count_ones())
            .sum();
        let wide = layout.wide.iter().filter(|(first, count)| row[*first..first + count].iter().any(|&w| w != 0));
        runs + wide.count() as u32
    }

    /// The rays in the gate of a hypothesis, ascending.
    pub fn rays(&self, hypothesis: usize) -> impl Iterator<Item = usize> + '_ {
        self.row(hypothesis).iter().enumerate().flat_map(move |(word, &bits)| {
            ones(bits).map(move |bit| self.layout.ray_of_bit[word * LANES + bit as usize] as usize)
        })
    }

    /// The set of bits of some rays, to give to [`Ballot::remove`].
    #[must_use]
    pub fn bits_of(&self, rays: &[usize]) -> Vec<u64> {
        let mut set = vec![0; self.words];
        for &ray in rays {
            let bit = self.layout.bit_of_ray[ray] as usize;
            set[bit / LANES] |= 1 << (bit % LANES);
        }
        set
    }

    /// Take rays off a hypothesis; whether it had any of them.
    pub fn remove(&mut self, hypothesis: usize, bits: &[u64]) -> bool {
        let start = hypothesis * self.words;
        let mut hit = 0;
        for (word, &bits) in self.rows[start..start + self.words].iter_mut().zip(bits) {
            hit |= *word & bits;
            *word &= !bits;
        }
        hit != 0
    }

    fn row(&self, hypothesis: usize) -> &[u64] {
        &self.rows[hypothesis * self.words..(hypothesis + 1) * self.words]
    }
}

impl Layout {
    fn new(image: &[u32]) -> Self {
        let mut layout = Self {
            bit_of_ray: Vec::new(),
            ray_of_bit: Vec::new(),
            last: Vec::new(),
            body: Vec::new(),
            wide: Vec::new(),
        };
        let mut next = 0;
        for run in image.chunk_by(|a, b| a == b) {
            let room = LANES - next % LANES;
            if run.len() > room {
                next += room % LANES;
            }
            layout.place(run.len(), next);
            next += run.len();
            if run.len() > LANES {
                next = next.next_multiple_of(LANES);
            }
        }
        layout
    }

    fn place(&mut self, length: usize, start: usize) {
        let end = start + length;
        self.ray_of_bit.resize(end.next_multiple_of(LANES), u32::MAX);
        self.last.resize(end.div_ceil(LANES), 0);
        self.body.resize(end.div_ceil(LANES), 0);
        for bit in start..end {
            self.ray_of_bit[bit] = self.bit_of_ray.len() as u32;
            self.bit_of_ray.push(bit as u32);
        }
        if length > LANES {
            self.wide.push((start / LANES, length.div_ceil(LANES)));
        } else {
            let word = start / LANES;
            self.last[word] |= 1 << ((end - 1) % LANES);
            self.body[word] |= ((1_u64 << (length - 1)) - 1) << (start % LANES);
        }
    }
}
