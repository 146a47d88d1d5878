//! The voting kernel: does a point project into a ray's gate? `f32`, vectorised, dispatched at run time.
//!
//! For each ray a 3x4 matrix gives `(a, b, c) = A [X; 1]`; the point is inside where
//! `a² + b² < c² + floor` and `c > 0` (the gate is divided into A), which needs no division. In `f32` this is uncertain
//! within a margin that is known, so the kernel answers twice: `maybe` (no point that is inside is missing) and `sure`
//! (every point in it is inside). The caller tests the few points between the two in `f64`, which makes the result
//! independent of the instruction set.

use nalgebra::Vector3;
pub use pulp::Arch;
use pulp::{Simd, WithSimd};

use crate::ray::Ray;

/// Rays that are tested together: one bit each in the answer.
pub const LANES: usize = 64;
const COEFFICIENTS: usize = 13;
const FLOOR: usize = 12;
/// Lanes that are tested at once; those of a block without any ray are left out.
const GROUP: usize = 16;
/// Points that are tested against a block while it is in the nearest cache.
const TILE: usize = 64;
/// Relative width of the band between `sure` and `maybe`.
const BAND: f32 = 0.01;
/// Bound on the relative `f32` error of a 4-term dot product of rounded inputs (a count of roundings, doubled).
const ROUNDING: f64 = 16.0 * (f32::EPSILON as f64);

/// How near a point must project: `|(a, b)|² < radius_px² (c² + floor_m2)`, a radius that grows at small depths c.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gate {
    /// Radius for distant points, px.
    pub radius_px: f64,
    /// Squared depth at which the radius is `sqrt(2)` times as large, m².
    pub floor_m2: f64,
}

impl Gate {
    /// Whether a point with this `(a, b, c)` is inside.
    #[inline]
    #[must_use]
    pub fn holds(&self, projected: &Vector3<f64>) -> bool {
        let error2 = projected.x * projected.x + projected.y * projected.y;
        let depth = projected.z;
        depth > 0.0 && error2 < self.radius_px * self.radius_px * (depth * depth + self.floor_m2)
    }
}

/// The matrices of up to 64 rays, one coefficient after the other, so that lanes are contiguous.
#[derive(Clone)]
struct Block([[f32; LANES]; COEFFICIENTS]);

impl Block {
    /// Lanes without a ray have `c = -1` everywhere: never inside.
    fn empty() -> Self {
        let mut block = Self([[0.0; LANES]; COEFFICIENTS]);
        block.0[FLOOR - 1] = [-1.0; LANES];
        block
    }

    fn set(&mut self, lane: usize, ray: &Ray, gate: Gate) {
        self.0[FLOOR][lane] = gate.floor_m2 as f32;
        for row in 0..3 {
            let scale = if row < 2 { 1.0 / gate.radius_px } else { 1.0 };
            let m = ray.residual_from_world.row(row) * scale;
            for column in 0..3 {
                self.0[row * 4 + column][lane] = m[column] as f32;
            }
            self.0[row * 4 + 3][lane] = -(m * ray.center)[0] as f32;
        }
    }
}

/// Rays ready for the kernel; bit `i` of the answers is lane `i`.
pub struct Gates {
    blocks: Vec<Block>,
    /// The lanes of each block that have a ray: far from the origin, margins take in the others as well.
    used: Vec<u64>,
    /// Largest `|row| / gate` of a ray, and largest distance of a camera from the origin, m.
    largest_row: f64,
    largest_center_m: f64,
}

/// The margins of the two answers for points up to some distance from the origin.
#[derive(Clone, Copy)]
struct Margins {
    maybe: f32,
    sure: f32,
    depth: f32,
}

impl Gates {
    /// Place rays with their gates on lanes.
    ///
    /// Centres should lie near the origin: `f32` has 24 bits.
    #[must_use]
    pub fn new<'a>(rays: impl Iterator<Item = (u32, &'a Ray, Gate)>) -> Self {
        let mut gates = Self { blocks: Vec::new(), used: Vec::new(), largest_row: 1.0, largest_center_m: 0.0 };
        for (lane, ray, gate) in rays {
            let block = lane as usize / LANES;
            while gates.blocks.len() <= block {
                gates.blocks.push(Block::empty());
                gates.used.push(0);
            }
            gates.used[block] |= 1 << (lane as usize % LANES);
            gates.blocks[block].set(lane as usize % LANES, ray, gate);
            let m = &ray.residual_from_world;
            gates.largest_row = gates.largest_row.max(m.row(0).norm().max(m.row(1).norm()) / gate.radius_px);
            gates.largest_center_m = gates.largest_center_m.max(ray.center.norm());
        }
        gates
    }

    /// Words of 64 bits in the answer for one point.
    #[must_use]
    pub fn words(&self) -> usize {
        self.blocks.len()
    }

    /// Test all points against all rays, with the best instructions that this machine has.
    ///
    /// `maybe` and `sure` have `points.len() * self.words()` words and are overwritten, point after point.
    ///
    /// # Panics
    /// If `maybe` or `sure` has another length.
    pub fn test(&self, points: &[Vector3<f64>], maybe: &mut [u64], sure: &mut [u64]) {
        self.test_on(Arch::new(), points, maybe, sure);
    }

    /// The first of the two answers alone: no point that is inside is missing.
    ///
    /// `maybe` has `points.len() * self.words()` words and is overwritten, point after point.
    ///
    /// # Panics
    /// If `maybe` has another length.
    pub fn test_maybe(&self, points: &[Vector3<f64>], maybe: &mut [u64]) {
        assert_eq!(maybe.len(), points.len() * self.words(), "one word of maybe for each point and block");
        if !maybe.is_empty() {
            let margins = self.margins(points);
            Arch::new().dispatch(Pass { gates: self, points, margins, maybe, sure: &mut [] });
        }
    }

    /// [`Gates::test`] with given instructions, to compare them.
    ///
    /// # Panics
    /// If `maybe` or `sure` has another length.
    pub fn test_on(&self, arch: Arch, points: &[Vector3<f64>], maybe: &mut [u64], sure: &mut [u64]) {
        assert_eq!(maybe.len(), points.len() * self.words(), "one word of maybe for each point and block");
        assert_eq!(sure.len(), maybe.len(), "as many words of sure as of maybe");
        if !maybe.is_empty() {
            let margins = self.margins(points);
            arch.dispatch(Pass { gates: self, points, margins, maybe, sure });
        }
    }

    /// With `s` a bound on the error of a and b: `(c + s)² <= (1 + e) c² + (1 + 1/e) s²`, likewise below.
    fn margins(&self, points: &[Vector3<f64>]) -> Margins {
        let reach = points.iter().map(Vector3::norm).fold(self.largest_center_m, f64::max) + self.largest_center_m;
        let error = ROUNDING * self.largest_row * reach;
        let band = f64::from(BAND);
        Margins {
            maybe: (error * error * (1.0 + 1.0 / band) * 2.0) as f32,
            sure: (error * error * (1.0 / band) * 2.0) as f32,
            depth: (ROUNDING * reach) as f32,
        }
    }
}

/// The instruction sets that this machine has, by name, the plainest first.
#[must_use]
pub fn instruction_sets() -> Vec<(&'static str, Arch)> {
    let mut sets = vec![("baseline", Arch::Scalar)];
    #[cfg(target_arch = "x86_64")]
    {
        sets.extend(pulp::x86::V3::try_new().map(|v3| ("avx2", Arch::V3(v3))));
        sets.extend(pulp::x86::V4::try_new().map(|v4| ("avx512", Arch::V4(v4))));
    }
    sets
}

struct Pass<'a> {
    gates: &'a Gates,
    points: &'a [Vector3<f64>],
    margins: Margins,
    maybe: &'a mut [u64],
    /// As long, or empty: then it is not asked.
    sure: &'a mut [u64],
}

impl WithSimd for Pass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        // Vectors of 8 and more mean AVX2 or AVX-512 here, which both fuse; elsewhere a fused multiply-add
        // may be a slow library call.
        if S::F32_LANES >= 8 { self.run::<true>() } else { self.run::<false>() }
    }
}

impl Pass<'_> {
    #[inline(always)]
    fn run<const FUSED: bool>(self) {
        let Self { gates, points, margins, maybe, sure } = self;
        let words = gates.words();
        let is_sure_asked = !sure.is_empty();
        for (tile, points) in points.chunks(TILE).enumerate() {
            for (word, (block, used)) in gates.blocks.iter().zip(&gates.used).enumerate() {
                let groups = (u64::BITS - used.leading_zeros()).div_ceil(GROUP as u32) as usize;
                for (i, point) in points.iter().enumerate() {
                    let x = [point.x as f32, point.y as f32, point.z as f32];
                    let at = (tile * TILE + i) * words + word;
                    if is_sure_asked {
                        let (may, must) = test_block::<FUSED, true>(block, groups, x, margins);
                        (maybe[at], sure[at]) = (may & used, must & used);
                    } else {
                        maybe[at] = test_block::<FUSED, false>(block, groups, x, margins).0 & used;
                    }
                }
            }
        }
    }
}

/// The answers of the first groups of lanes of one block, as bits; the second one where it is asked. Plain loops over lanes, which compile to vector
/// instructions.
#[inline(always)]
fn test_block<const FUSED: bool, const SURE: bool>(
    block: &Block,
    groups: usize,
    x: [f32; 3],
    margins: Margins,
) -> (u64, u64) {
    let mut maybe = [[0_u8; GROUP]; LANES / GROUP];
    let mut sure = [[0_u8; GROUP]; LANES / GROUP];
    for (group, (maybe, sure)) in maybe.iter_mut().zip(&mut sure).take(groups).enumerate() {
        let m: [&[f32; GROUP]; COEFFICIENTS] = std::array::from_fn(|row| &block.0[row].as_chunks().0[group]);
        for lane in 0..GROUP {
            let dot = |row: usize| {
                let r = row * 4;
                let sum = multiply_add::<FUSED>(m[r][lane], x[0], m[r + 3][lane]);
                let sum = multiply_add::<FUSED>(m[r + 1][lane], x[1], sum);
                multiply_add::<FUSED>(m[r + 2][lane], x[2], sum)
            };
            let (a, b, c) = (dot(0), dot(1), dot(2));
            let error2 = multiply_add::<FUSED>(a, a, b * b);
            let c2 = multiply_add::<FUSED>(c, c, m[FLOOR][lane]);
            maybe[lane] =
                u8::from(error2 < multiply_add::<FUSED>(c2, 1.0 + BAND, margins.maybe)) & u8::from(c > -margins.depth);
            if SURE {
                sure[lane] = u8::from(error2 < multiply_add::<FUSED>(c2, 1.0 - BAND, -margins.sure))
                    & u8::from(c > margins.depth);
            }
        }
    }
    (bits(maybe.as_flattened()), if SURE { bits(sure.as_flattened()) } else { 0 })
}

#[inline(always)]
fn multiply_add<const FUSED: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FUSED { a.mul_add(b, c) } else { a * b + c }
}

/// Pack 64 bytes of 0 or 1 into a word, byte 0 to bit 0.
#[inline(always)]
fn bits(bytes: &[u8]) -> u64 {
    let mut word = 0;
    for (i, eight) in bytes.as_chunks::<8>().0.iter().enumerate() {
        // The product gathers bit 0 of each byte in the top byte, in order.
        let gathered = u64::from_le_bytes(*eight).wrapping_mul(0x0102_0408_1020_4080) >> 56;
        word |= gathered << (8 * i);
    }
    word
}

/// The set bits of a word, ascending.
pub fn ones(mut bits: u64) -> impl Iterator<Item = u32> {
    std::iter::from_fn(move || {
        (bits != 0).then(|| {
            let bit = bits.trailing_zeros();
            bits &= bits - 1;
            bit
        })
    })
}
