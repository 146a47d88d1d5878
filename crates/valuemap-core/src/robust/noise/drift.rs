//! Pose errors that the images of a pass share: the covariance C of equation (1) of `docs/method.md`.
//!
//! A vote's residual is `r = J (X - X_0) + J b + J [X - C]_x w + e`: e is the detection's error; b and w are errors of position
//! and rotation. One part of them is the image's own, shared by all labels that it shows. Another part drifts along the drive as
//! an Ornstein-Uhlenbeck process: two errors d apart have the correlation `exp(-d / DRIFT_LENGTH_M)`. A drive is cut into short
//! segments of one drift each. The image's own error is marginalised first, then the drift segment by segment (Schur
//! complements), so that a hundred images before a red light count as one look.

use std::ops::Range;

use nalgebra::{DMatrix, DVector, Matrix3, Rotation3, SMatrix, Vector2, Vector3};

use super::spd::{Inverse, Matrix6, Vector6, product, product_transposed, scaled};
use super::{Noise, Sigmas, Spread, norm};
use crate::ray::Ray;
use crate::robust::scene::Scene;

type Matrix3x6 = SMatrix<f64, 3, 6>;

/// Distance over which drifting errors forget 63 % of themselves, m. With shorter ones, and shorter segments, positions get better in some real data, and more
/// labels are false.
pub const DRIFT_LENGTH_M: f64 = 100.0;
/// Freedom left to a residual that the point follows altogether, as a share of its variance. Without it that residual would be divided by zero, and others
/// hardly feel it.
const LEAST_FREEDOM: f64 = 1e-3;
/// A segment's own error is at least this share of the drift: less is no error, and its inverse no number.
const LEAST_SHARE: f64 = 1e-4;
/// Drifting errors are one within this distance, m. They forget a tenth of themselves along it (`DRIFT_LENGTH_M`).
pub const SEGMENT_M: f64 = 10.0;

/// One vote's residual at the position of its label, with its derivatives.
#[derive(Debug, Clone, PartialEq)]
pub struct Look {
    /// Which of the labels it is a look at.
    pub label: usize,
    /// The image.
    pub image: u32,
    /// Residual, px.
    pub residual: [f64; 2],
    /// By the position.
    pub by_point: [Vector3<f64>; 2],
    /// By the error of the image's rotation (rad, in the world); by that of its position it is as by the label's.
    pub by_turn: [Vector3<f64>; 2],
    /// Standard deviations of the part of these errors that drifts along the pass.
    pub drift_sigma: Sigmas,
    /// Of the part that the images of one segment share, and no others.
    pub segment_sigma: Sigmas,
    /// Of the part that the image has for itself.
    pub own_sigma: Sigmas,
    /// Variance of the detection, each axis, px².
    pub detection_px2: f64,
    /// Variance of all but the drift, each axis, px².
    pub variance: f64,
    /// How far its pass had driven, m.
    pub driven_m: f64,
}

/// From where one looks: a ray with all that is known of its image and its detection, side by side in memory.
#[derive(Debug, Clone)]
pub struct Vantage {
    ray: Ray,
    image: u32,
    driven_m: f64,
    drift_sigma: Sigmas,
    segment_sigma: Sigmas,
    own_sigma: Sigmas,
    detection_px2: f64,
    /// Of all errors but the drift.
    spread: Spread,
    /// The same as the line of sight is turned with it.
    of_sight: Spread,
    /// Measured range with its standard deviation, m; NaN where there is none.
    pub range_m: [f64; 2],
}

impl Vantage {
    /// That of a ray.
    #[must_use]
    pub fn of(scene: &Scene, noise: &Noise, ray: u32) -> Self {
        let view = scene.view(ray);
        let own = noise.own(scene, ray);
        Self {
            ray: *scene.ray(ray),
            image: scene.image_of(ray),
            driven_m: view.driven_m,
            drift_sigma: noise.of_drift(view),
            segment_sigma: noise.of_segment(view),
            own_sigma: noise.of_image(view),
            detection_px2: noise.detection_px2(scene, ray),
            spread: own,
            of_sight: own,
            range_m: [scene.range_m[ray as usize], scene.range_sigma_m[ray as usize]],
        }
    }

    /// The same, but with the line of sight that another noise makes probable: while the noise is sought, lines that follow it would be
    /// one more thing to fit.
    #[must_use]
    pub fn with_sight_of(mut self, scene: &Scene, noise: &Noise, ray: u32) -> Self {
        self.of_sight = noise.own(scene, ray);
        self
    }

    /// The same, but looked at from where its camera is said to be.
    #[must_use]
    pub fn as_said(mut self) -> Self {
        self.of_sight.near_px2 = 0.0;
        self
    }

    /// The same with variances so many times as large: of what its image is off by itself, and its detection.
    #[must_use]
    pub fn with_variance(mut self, of_image: f64, of_detection: f64) -> Self {
        self.own_sigma.position_m *= of_image.sqrt();
        self.own_sigma.rotation_rad *= of_image.sqrt();
        self.detection_px2 *= of_detection;
        self.spread.far_px2 *= of_detection;
        self.spread.near_px2 *= of_detection;
        self
    }

    /// The camera centre, m.
    #[must_use]
    pub fn center(&self) -> &Vector3<f64> {
        &self.ray.center
    }

    /// The look at one of some labels, which is at `point`; nothing if that is behind it.
    ///
    /// Its derivatives are those of the line of sight as it probably is, given this residual alone. Those of the line from where the
    /// camera is said to be are wrong in the same way as the residual is: what both have in common moves a label away from the cameras,
    /// however many look at it, so that drives from two sides never agree.
    #[inline]
    #[must_use]
    pub fn look(&self, label: usize, point: &Vector3<f64>) -> Option<Look> {
        self.look_along(&self.ray, label, point, |depth| self.of_sight.share_of_position(depth))
    }

    /// The same with its derivatives where its image probably was, given all looks together: its pose error is about `error`, m and rad.
    #[must_use]
    pub fn look_where_it_was(&self, label: usize, point: &Vector3<f64>, error: &Vector6) -> Option<Look> {
        let (shift, turn) = (error.fixed_rows::<3>(0), error.fixed_rows::<3>(3));
        let turn = Rotation3::from_scaled_axis(turn.into_owned());
        let probable = Ray {
            residual_from_world: self.ray.residual_from_world * turn.inverse(),
            center: self.ray.center + shift,
            direction: turn * self.ray.direction,
        };
        let mut look = self.look_along(&probable, label, point, |_| 0.0)?;
        look.shift(error);
        Some(look)
    }

    #[inline]
    fn look_along(
        &self,
        ray: &Ray,
        label: usize,
        point: &Vector3<f64>,
        share_of_position: impl Fn(f64) -> f64,
    ) -> Option<Look> {
        let projected = ray.project(point);
        (projected.z > 0.0).then(|| self.look_in_front(ray, label, point, &projected, share_of_position(projected.z)))
    }

    /// The look at a point that is in front of its camera.
    #[inline]
    fn look_in_front(
        &self,
        ray: &Ray,
        label: usize,
        point: &Vector3<f64>,
        projected: &Vector3<f64>,
        share_of_position: f64,
    ) -> Look {
        let (residual, rows) = ray.linearize_in_front(projected, share_of_position);
        let away = point - ray.center;
        let by_point = rows.map(|row| row.transpose());
        Look {
            label,
            image: self.image,
            residual,
            by_point,
            by_turn: by_point.map(|column| away.cross(&column)),
            drift_sigma: self.drift_sigma,
            segment_sigma: self.segment_sigma,
            own_sigma: self.own_sigma,
            detection_px2: self.detection_px2,
            variance: self.spread.variance(projected.z),
            driven_m: self.driven_m,
        }
    }

    /// The look [by itself](Look::by_itself) at the only label, which is in front of it.
    #[inline]
    fn look_by_itself(&self, point: &Vector3<f64>) -> Look {
        let projected = self.ray.project(point);
        let share_of_position = self.of_sight.share_of_position(projected.z);
        self.look_in_front(&self.ray, 0, point, &projected, share_of_position).by_itself()
    }
}

/// The looks [by themselves](Look::by_itself) from some vantages at the only label, which is at `point`; nothing if that is behind any.
#[must_use]
pub fn looks_by_themselves(vantages: &[Vantage], point: &Vector3<f64>) -> Option<Vec<Look>> {
    // First of all, so that each look is written once, where it stays.
    let are_in_front = vantages.iter().all(|vantage| vantage.ray.project(point).z > 0.0);
    are_in_front.then(|| vantages.iter().map(|vantage| vantage.look_by_itself(point)).collect())
}

impl Look {
    /// The look of a ray at one of some labels, which is at `point`; nothing if that is behind it.
    #[must_use]
    pub fn of(scene: &Scene, noise: &Noise, ray: u32, label: usize, point: &Vector3<f64>) -> Option<Self> {
        Vantage::of(scene, noise, ray).look(label, point)
    }

    /// The look as if its image had its own error for this label alone: less than what is known, and much quicker.
    #[inline]
    #[must_use]
    pub fn by_itself(mut self) -> Self {
        self.detection_px2 = self.variance;
        self.own_sigma = Sigmas::NONE;
        self
    }

    /// The look of a ray [by itself](Self::by_itself) with another noise along the same line of sight; its label is `depth_m` away.
    #[must_use]
    pub fn with_noise(&self, scene: &Scene, noise: &Noise, ray: u32, depth_m: f64) -> Self {
        let view = scene.view(ray);
        let variance = noise.own(scene, ray).variance(depth_m);
        Self {
            drift_sigma: noise.of_drift(view),
            segment_sigma: noise.of_segment(view),
            own_sigma: Sigmas::NONE,
            detection_px2: variance,
            variance,
            ..self.clone()
        }
    }

    /// What is new in a look [by itself](Self::by_itself) after the one before it, whose error, in sigmas, it shares with a correlation: a look of
    /// variance 1. With it the logarithm of the determinant of what is new, px⁴.
    #[must_use]
    pub fn innovation(&self, before: Option<&Self>, correlation: f64) -> (Self, f64) {
        let correlation = if before.is_some() { correlation } else { 0.0 };
        let sigma_px = (self.detection_px2 * (1.0 - correlation * correlation)).sqrt();
        let mut new = self.clone();
        for axis in 0..2 {
            new.residual[axis] /= sigma_px;
            new.by_point[axis] /= sigma_px;
            new.by_turn[axis] /= sigma_px;
            if let Some(before) = before {
                let share = correlation * (self.detection_px2 / before.detection_px2).sqrt() / sigma_px;
                new.residual[axis] -= before.residual[axis] * share;
                new.by_point[axis] -= before.by_point[axis] * share;
                new.by_turn[axis] -= before.by_turn[axis] * share;
            }
        }
        (new.detection_px2, new.variance) = (1.0, 1.0);
        (new, 4.0 * sigma_px.ln())
    }

    /// The look, which counts with a weight, with the error that its image has for itself added to the detection's: mixed so that
    /// both residuals are independent, with variance 1; and the determinant of their covariance, px⁴. Only for the one look of an image; nothing if
    /// numbers overflow.
    fn whitened(&self, weight: f64) -> Option<(Self, f64)> {
        let own = self.own_sigma.each();
        let scaled = [0, 1].map(|axis| self.by_pose(axis).component_mul(&own));
        let detection = self.detection_px2 / weight;
        let first = (detection + scaled[0].norm_squared()).sqrt();
        let tie = scaled[0].dot(&scaled[1]) / first;
        let second = (detection + scaled[1].norm_squared() - tie * tie).sqrt();
        let mut white = self.clone();
        white.residual[0] /= first;
        white.by_point[0] /= first;
        white.by_turn[0] /= first;
        white.residual[1] = (self.residual[1] - tie * white.residual[0]) / second;
        white.by_point[1] = (self.by_point[1] - white.by_point[0] * tie) / second;
        white.by_turn[1] = (self.by_turn[1] - white.by_turn[0] * tie) / second;
        white.detection_px2 = 1.0;
        (first * second > 0.0).then_some((white, (first * second).powi(2)))
    }

    /// What is known of the height of a label above its image, as one more look of that image: the label is higher than expected by so much, m, with
    /// that variance, m². Where the image is higher than said, so is the label.
    #[must_use]
    pub fn at_height(&self, label: usize, up: &Vector3<f64>, higher_m: f64, variance_m2: f64) -> Self {
        Self {
            label,
            residual: [higher_m, 0.0],
            by_point: [*up, Vector3::zeros()],
            by_turn: [Vector3::zeros(); 2],
            detection_px2: variance_m2,
            variance: variance_m2,
            ..self.clone()
        }
    }

    /// The look with a pose error, m and rad, taken out that is known but for some remainder, which then is the drift.
    #[must_use]
    pub fn with_drift(mut self, error: &Vector6, remainder: Sigmas) -> Self {
        self.shift(error);
        self.drift_sigma = remainder;
        self.segment_sigma = Sigmas::NONE;
        self
    }

    /// One axis of the residual by the errors of the image's position (m) and rotation (rad, in the world).
    #[inline]
    #[must_use]
    pub fn by_pose(&self, axis: usize) -> Vector6 {
        let (shift, turn) = (&self.by_point[axis], &self.by_turn[axis]);
        Vector6::new(shift.x, shift.y, shift.z, turn.x, turn.y, turn.z)
    }

    /// Standard deviations of all that the image shares with others of its segment.
    #[must_use]
    pub fn shared_sigma(&self) -> Sigmas {
        Sigmas {
            position_m: norm(self.segment_sigma.position_m, self.drift_sigma.position_m),
            rotation_rad: norm(self.segment_sigma.rotation_rad, self.drift_sigma.rotation_rad),
        }
    }

    fn shift(&mut self, error: &Vector6) {
        for axis in 0..2 {
            self.residual[axis] += self.by_pose(axis).dot(error);
        }
    }

    /// The residual, px, without what a pose error, m and rad, makes of it.
    fn without(&self, error: &Vector6) -> Vector2<f64> {
        Vector2::from([0, 1].map(|axis| self.residual[axis] - self.by_pose(axis).dot(error)))
    }

    /// Squared residual in sigmas, studentised: a vote that pulls the point towards itself has a small residual, and is expected
    /// to. `left` is the residual without the drift, px; `covariance` that of the point if the drift were known, m².
    #[must_use]
    pub fn studentised(&self, left: &Vector2<f64>, covariance: &Matrix3<f64>, weight: f64) -> f64 {
        let moved = self.by_point.map(|column| covariance * column * weight);
        let pull = |i: usize, k: usize| self.by_point[i].dot(&moved[k]);
        let free = self.variance * (1.0 + LEAST_FREEDOM);
        let (x, y, both) = (free - pull(0, 0), free - pull(1, 1), pull(0, 1));
        let determinant = x * y - both * both;
        if !(x > 0.0 && determinant > 0.0) {
            return f64::INFINITY;
        }
        (y * left.x * left.x + 2.0 * both * left.x * left.y + x * left.y * left.y) / determinant
    }
}

/// Normal equations of the positions of some labels, three rows each, and the terms of their likelihood.
#[derive(Debug, Clone)]
pub struct Normals {
    /// Information about the positions, 1/m².
    pub information: DMatrix<f64>,
    /// Gradient of half the squared residuals, 1/m.
    pub gradient: DVector<f64>,
    /// Squared residuals in sigmas, pose errors taken out.
    pub square: f64,
}

impl Normals {
    /// Those of no looks at some labels.
    #[must_use]
    pub fn nothing(labels: usize) -> Self {
        let size = 3 * labels;
        Self { information: DMatrix::zeros(size, size), gradient: DVector::zeros(size), square: 0.0 }
    }

    /// Add information about two labels, or one.
    pub fn add(&mut self, a: usize, b: usize, block: &Matrix3<f64>) {
        let mut view = self.information.fixed_view_mut::<3, 3>(3 * a, 3 * b);
        view += block;
    }

    /// Add to the gradient of a label.
    pub fn add_gradient(&mut self, a: usize, rows: &Vector3<f64>) {
        let mut view = self.gradient.fixed_rows_mut::<3>(3 * a);
        view += rows;
    }

    /// Add what is said of some of the labels.
    pub fn add_those_of(&mut self, labels: &[usize], some: &Self) {
        for (b, &second) in labels.iter().enumerate() {
            for (a, &first) in labels.iter().enumerate() {
                let mut view = self.information.fixed_view_mut::<3, 3>(3 * first, 3 * second);
                view += some.information.fixed_view::<3, 3>(3 * a, 3 * b);
            }
            let mut view = self.gradient.fixed_rows_mut::<3>(3 * second);
            view += some.gradient.fixed_rows::<3>(3 * b);
        }
        self.square += some.square;
    }

    /// What was said of the only label.
    #[must_use]
    pub fn of_one(&self) -> (Matrix3<f64>, Vector3<f64>) {
        (self.information.fixed_view::<3, 3>(0, 0).into_owned(), self.gradient.fixed_rows::<3>(0).into_owned())
    }
}

/// What the looks of one visit of a pass at some labels say, all pose errors taken out.
pub struct Drive<'a> {
    /// The normal equations of the positions.
    pub normals: Normals,
    looks: &'a [Look],
    segments: Vec<Solved>,
    /// What the errors that images have for themselves add to the logarithm of the determinant.
    ln_determinant_of_images: f64,
}

/// What is said about the pose error of a segment, in sigmas of the drift: by the looks of the segment, or about its drift by all before.
struct Segment {
    information: Matrix6,
    gradient: Vector6,
    /// How it depends on the positions of the labels seen so far.
    cross: Vec<(usize, Matrix3x6)>,
}

/// The error that a segment has for itself, taken out: what it is once its drift is known.
struct OwnOfSegment {
    /// What its looks say of the error of the segment, drift and own, in sigmas of the drift.
    information: Matrix6,
    gradient: Vector6,
    /// Its covariance once its looks are known, in sigmas of the drift.
    covariance: Matrix6,
    /// What the marginalisation adds to the logarithm of the determinant.
    ln_determinant: f64,
}

/// A segment whose drift is taken out.
struct Solved {
    looks: Range<usize>,
    information: Inverse,
    gradient: Vector6,
    /// How much a unit of the next segment's drift pulls at this one's.
    tie: f64,
    /// How stiff this pull is.
    stiffness: f64,
    /// The error that the segment has for itself; nothing if it has none.
    own: Option<OwnOfSegment>,
}

impl<'a> Drive<'a> {
    /// Go along the looks of a visit at one label, which all count alike; nothing if their numbers overflow.
    #[must_use]
    pub fn at_one(looks: &'a [Look]) -> Option<Self> {
        Self::along(looks, &vec![1.0; looks.len()], 1)
    }

    /// Go along the looks of a visit, in their order; nothing if their numbers overflow.
    #[must_use]
    pub fn along(looks: &'a [Look], weights: &[f64], labels: usize) -> Option<Self> {
        let mut normals = Normals::nothing(labels);
        // The prior of the first segment: drifts are counted in their own sigmas.
        let mut carried = Segment { information: Matrix6::identity(), ..Segment::nothing() };
        let mut segments = Vec::new();
        let mut ln_determinant_of_images = 0.0;
        let mut start = 0;
        while start < looks.len() {
            let end = start + segment_length(&looks[start..], |look| look.driven_m);
            let mut at = start;
            let mut segment = Segment::nothing();
            for alike in looks[start..end].chunk_by(is_alike) {
                let weights = &weights[at..at + alike.len()];
                at += alike.len();
                if alike[0].own_sigma == Sigmas::NONE {
                    segment.add(alike, weights, &mut normals);
                } else {
                    ln_determinant_of_images += segment.add_image(alike, weights, &mut normals);
                }
            }
            // The next segment's drift is `keep` times this one's, and something new of variance `1 - keep²`.
            let distance = looks.get(end).map_or(f64::INFINITY, |next| (next.driven_m - looks[start].driven_m).abs());
            let keep = (-distance / DRIFT_LENGTH_M).exp();
            let of_segment = looks[start].segment_sigma;
            let own = if of_segment == Sigmas::NONE {
                None
            } else {
                Some(segment.take_own_out(of_segment, looks[start].drift_sigma, &mut normals)?)
            };
            let (solved, next) = carried.and(&segment).take_out(keep, start..end, own, &mut normals)?;
            segments.push(solved);
            carried = next;
            start = end;
        }
        Some(Self { normals, looks, segments, ln_determinant_of_images })
    }

    /// Logarithm of the determinant of the covariance of the residuals, px⁴ a look, as if all counted alike.
    #[must_use]
    pub fn log_determinant(&self) -> f64 {
        let of_looks: f64 = self.looks.iter().map(|look| 2.0 * look.detection_px2.ln()).sum();
        let of_segment = |segment: &Solved| {
            let of_own = segment.own.as_ref().map_or(0.0, |own| own.ln_determinant);
            segment.information.determinant.ln() - 6.0 * segment.stiffness.ln() + of_own
        };
        of_looks + self.ln_determinant_of_images + self.segments.iter().map(of_segment).sum::<f64>()
    }

    /// Residuals, px, after the most probable error of the segment is taken out, in the order of the looks.
    #[must_use]
    pub fn left(&self) -> Vec<Vector2<f64>> {
        let mut left = Vec::with_capacity(self.looks.len());
        for (segment, drift) in self.segments.iter().zip(self.drifts()) {
            let looks = &self.looks[segment.looks.clone()];
            left.extend(looks.iter().map(|look| look.without(&drift.component_mul(&look.drift_sigma.each()))));
        }
        left
    }

    /// The most probable error of each segment, its drift and its own, in sigmas of the drift.
    fn drifts(&self) -> Vec<Vector6> {
        let mut drifts = vec![Vector6::zeros(); self.segments.len()];
        let mut of_next = Vector6::zeros();
        for (segment, drift) in self.segments.iter().zip(&mut drifts).rev() {
            *drift = product(&segment.information.matrix, &(of_next * segment.tie + segment.gradient));
            of_next = *drift;
        }
        for (segment, drift) in self.segments.iter().zip(&mut drifts) {
            if let Some(own) = &segment.own {
                *drift += product(&own.covariance, &(own.gradient - product(&own.information, drift)));
            }
        }
        drifts
    }

    /// The most probable pose error of the image of each look, drift and its own, m and rad.
    #[must_use]
    pub fn pose_errors(&self, weights: &[f64]) -> Vec<Vector6> {
        let drifts = self.segments.iter().zip(self.drifts());
        let of_segment = |(segment, drift): (&Solved, Vector6)| {
            let looks = self.looks[segment.looks.clone()].iter();
            looks.map(move |look| drift.component_mul(&look.drift_sigma.each()))
        };
        let mut errors: Vec<Vector6> = drifts.flat_map(of_segment).collect();
        let mut at = 0;
        for image in self.looks.chunk_by(|a, b| a.image == b.image) {
            let range = at..at + image.len();
            if let Some(of_image) = own_error(image, &weights[range.clone()], &errors[at]) {
                errors[range].iter_mut().for_each(|error| *error += of_image);
            }
            at += image.len();
        }
        errors
    }
}

/// What a look that is the only one of its visit at the only label says, all pose errors taken out: [`Drive::along`] of one look, by the
/// covariance of its two residuals.
pub struct OneLook {
    /// Information about the position, 1/m².
    pub information: Matrix3<f64>,
    /// Gradient of half the squared residuals, 1/m.
    pub gradient: Vector3<f64>,
    /// Squared residuals in sigmas.
    pub square: f64,
    /// Logarithm of the determinant of the covariance of the residuals, px⁴.
    pub log_determinant: f64,
    /// The residual, px, after the most probable error of the pose is taken out.
    pub left: Vector2<f64>,
}

impl OneLook {
    /// Of a look [by itself](Look::by_itself), which counts with a weight; nothing if its numbers overflow.
    #[must_use]
    pub fn of(look: &Look, weight: f64) -> Option<Self> {
        let shared = look.shared_sigma().each();
        let by_pose = [0, 1].map(|axis| look.by_pose(axis).component_mul(&shared));
        let detection = look.detection_px2 / weight;
        let (xx, yy) = (detection + by_pose[0].norm_squared(), detection + by_pose[1].norm_squared());
        let xy = by_pose[0].dot(&by_pose[1]);
        let determinant = xx * yy - xy * xy;
        if !(xx > 0.0 && determinant > 0.0) {
            return None;
        }
        let [rx, ry] = look.residual;
        let white = [(yy * rx - xy * ry) / determinant, (xx * ry - xy * rx) / determinant];
        let [x, y] = &look.by_point;
        let (of_x, of_y) = ((x * yy - y * xy) / determinant, (y * xx - x * xy) / determinant);
        Some(Self {
            information: of_x * x.transpose() + of_y * y.transpose(),
            gradient: x * white[0] + y * white[1],
            square: rx * white[0] + ry * white[1],
            log_determinant: determinant.ln() + 2.0 * weight.ln(),
            left: Vector2::from(white) * detection,
        })
    }
}

/// The most probable error that an image has for itself if its drift is as said, m and rad; nothing if numbers overflow.
fn own_error(looks: &[Look], weights: &[f64], drift: &Vector6) -> Option<Vector6> {
    let own = looks[0].own_sigma.each();
    if let ([look], [weight]) = (looks, weights) {
        let (white, _) = look.whitened(*weight)?;
        let left = white.without(drift);
        let gradient = white.by_pose(0) * left.x + white.by_pose(1) * left.y;
        return Some(own.component_mul(&own.component_mul(&gradient)));
    }
    let (mut of_pose, mut gradient) = (Matrix6::zeros(), Vector6::zeros());
    for (look, weight) in looks.iter().zip(weights) {
        let left = look.without(drift);
        for axis in 0..2 {
            let pose = look.by_pose(axis);
            let weighted = pose * (weight / look.detection_px2);
            of_pose += pose * weighted.transpose();
            gradient += weighted * left[axis];
        }
    }
    let known = Inverse::of(&(Matrix6::identity() + scaled(&of_pose, &own)))?;
    Some(own.component_mul(&product(&known.matrix, &own.component_mul(&gradient))))
}

impl Segment {
    /// Add looks at one label whose images have no errors that they share with others, and drift alike.
    fn add(&mut self, looks: &[Look], weights: &[f64], normals: &mut Normals) {
        // Positions of label and image move a residual alike: three blocks make up all products.
        let (mut of_shift, mut of_both, mut of_turn) = (Matrix3::zeros(), Matrix3::zeros(), Matrix3::zeros());
        let (mut by_shift, mut by_turn) = (Vector3::zeros(), Vector3::zeros());
        for (look, robust_weight) in looks.iter().zip(weights) {
            let weight = robust_weight / look.detection_px2;
            for axis in 0..2 {
                let (r, shift, turn) = (look.residual[axis], look.by_point[axis], look.by_turn[axis]);
                let (weighted_shift, weighted_turn) = (shift * weight, turn * weight);
                of_shift += weighted_shift * shift.transpose();
                of_both += weighted_shift * turn.transpose();
                of_turn += weighted_turn * turn.transpose();
                by_shift += weighted_shift * r;
                by_turn += weighted_turn * r;
                normals.square += r * r * weight;
            }
        }
        let Look { label, drift_sigma: Sigmas { position_m, rotation_rad }, .. } = looks[0];
        normals.add(label, label, &of_shift);
        normals.add_gradient(label, &by_shift);
        let mut cross = Matrix3x6::zeros();
        cross.fixed_columns_mut::<3>(0).copy_from(&(of_shift * position_m));
        cross.fixed_columns_mut::<3>(3).copy_from(&(of_both * rotation_rad));
        self.add_cross(label, &cross);
        let both = of_both * (position_m * rotation_rad);
        let mut information = Matrix6::zeros();
        information.fixed_view_mut::<3, 3>(0, 0).copy_from(&(of_shift * (position_m * position_m)));
        information.fixed_view_mut::<3, 3>(0, 3).copy_from(&both);
        information.fixed_view_mut::<3, 3>(3, 0).copy_from(&both.transpose());
        information.fixed_view_mut::<3, 3>(3, 3).copy_from(&(of_turn * (rotation_rad * rotation_rad)));
        self.information += information;
        let (shift, turn) = (by_shift * position_m, by_turn * rotation_rad);
        self.gradient += Vector6::new(shift.x, shift.y, shift.z, turn.x, turn.y, turn.z);
    }

    /// Add the looks of one image, its own error taken out; returns what that adds to the logarithm of the determinant.
    fn add_image(&mut self, looks: &[Look], weights: &[f64], normals: &mut Normals) -> f64 {
        if let ([look], [weight]) = (looks, weights) {
            let Some((white, determinant)) = look.whitened(*weight) else { return 0.0 };
            self.add(&[white], &[1.0], normals);
            return (determinant * weight * weight).ln() - 2.0 * look.detection_px2.ln();
        }
        let (mut of_pose, mut gradient) = (Matrix6::zeros(), Vector6::zeros());
        let mut crosses: Vec<(usize, Matrix3x6)> = Vec::with_capacity(looks.len());
        for (look, robust_weight) in looks.iter().zip(weights) {
            let weight = robust_weight / look.detection_px2;
            let mut cross = Matrix3x6::zeros();
            for axis in 0..2 {
                let (r, column, pose) = (look.residual[axis], look.by_point[axis], look.by_pose(axis));
                normals.add(look.label, look.label, &(column * column.transpose() * weight));
                normals.add_gradient(look.label, &(column * (r * weight)));
                normals.square += r * r * weight;
                of_pose += pose * pose.transpose() * weight;
                gradient += pose * (r * weight);
                cross += column * pose.transpose() * weight;
            }
            crosses.push((look.label, cross));
        }
        let (own, drift) = (looks[0].own_sigma.each(), looks[0].drift_sigma.each());
        let Some(known) = Inverse::of(&(Matrix6::identity() + scaled(&of_pose, &own))) else { return 0.0 };
        // The covariance of the image's own error, once its looks are known.
        let error = scaled(&known.matrix, &own);
        normals.square -= gradient.dot(&product(&error, &gradient));
        let kept = Matrix6::identity() - product(&error, &of_pose);
        for (a, of_a) in &crosses {
            let by_error = product(of_a, &error);
            normals.add_gradient(*a, &-product(&by_error, &gradient));
            for (b, of_b) in &crosses {
                normals.add(*a, *b, &-product_transposed(&by_error, of_b));
            }
            let mut cross = product(of_a, &kept);
            for (mut column, sigma) in cross.column_iter_mut().zip(&drift) {
                column *= *sigma;
            }
            self.add_cross(*a, &cross);
        }
        self.information += scaled(&product(&of_pose, &kept), &drift);
        self.gradient += drift.component_mul(&product(&kept.transpose(), &gradient));
        known.determinant.ln()
    }

    fn add_cross(&mut self, label: usize, cross: &Matrix3x6) {
        match self.cross.iter_mut().find(|(other, _)| *other == label) {
            Some((_, sum)) => *sum += cross,
            None => self.cross.push((label, *cross)),
        }
    }

    fn nothing() -> Self {
        Self { information: Matrix6::zeros(), gradient: Vector6::zeros(), cross: Vec::new() }
    }

    /// Both, which must not rest on the same looks.
    fn and(mut self, other: &Self) -> Self {
        self.information += other.information;
        self.gradient += other.gradient;
        other.cross.iter().for_each(|(label, cross)| self.add_cross(*label, cross));
        self
    }

    /// Take the error out that the segment has for itself; what remains is said of its drift. Nothing if numbers overflow.
    fn take_own_out(&mut self, own: Sigmas, drift: Sigmas, normals: &mut Normals) -> Option<OwnOfSegment> {
        let share = own.each().zip_map(&drift.each(), |own, drift| if drift > 0.0 { own / drift } else { 0.0 });
        let share = share.map(|share| share.max(LEAST_SHARE));
        let known = Inverse::of(&(Matrix6::identity() + scaled(&self.information, &share)))?;
        let covariance = scaled(&known.matrix, &share);
        let of_segment = OwnOfSegment {
            information: self.information,
            gradient: self.gradient,
            covariance,
            ln_determinant: known.determinant.ln(),
        };
        for (i, (a, of_a)) in self.cross.iter().enumerate() {
            let by_own = product(of_a, &covariance);
            normals.add_gradient(*a, &-product(&by_own, &self.gradient));
            for (b, of_b) in &self.cross[..i] {
                let both = -product_transposed(&by_own, of_b);
                normals.add(*a, *b, &both);
                normals.add(*b, *a, &both.transpose());
            }
            normals.add(*a, *a, &-product_transposed(&by_own, of_a));
        }
        normals.square -= self.gradient.dot(&product(&covariance, &self.gradient));
        // Without differences of large numbers: with S the share and K the inverse of I + S M S, what is left of M is S⁻¹ (I - K) S⁻¹.
        let per_share = share.map(f64::recip);
        let kept = Matrix6::from_fn(|row, column| share[row] * known.matrix[(row, column)] * per_share[column]);
        self.cross.iter_mut().for_each(|(_, cross)| *cross = product(cross, &kept));
        self.gradient = product(&kept.transpose(), &self.gradient);
        self.information = scaled(&(Matrix6::identity() - known.matrix), &per_share);
        Some(of_segment)
    }

    /// Take the drift of this segment out; what remains is known of the next one's, which is `keep` times this one's.
    fn take_out(
        self,
        keep: f64,
        looks: Range<usize>,
        own: Option<OwnOfSegment>,
        normals: &mut Normals,
    ) -> Option<(Solved, Self)> {
        let stiffness = 1.0 / (1.0 - keep * keep);
        let tie = keep * stiffness;
        let information = Inverse::of(&(self.information + Matrix6::identity() * (keep * tie)))?;
        let inverse = information.matrix;
        let by_gradient = product(&inverse, &self.gradient);
        let by_cross: Vec<(usize, Matrix3x6)> =
            self.cross.iter().map(|(a, cross)| (*a, product(cross, &inverse))).collect();
        for (i, (a, of_a)) in by_cross.iter().enumerate() {
            normals.add_gradient(*a, &-product(of_a, &self.gradient));
            for (b, of_b) in &self.cross[..i] {
                let both = -product_transposed(of_a, of_b);
                normals.add(*a, *b, &both);
                normals.add(*b, *a, &both.transpose());
            }
            normals.add(*a, *a, &-product_transposed(of_a, &self.cross[i].1));
        }
        normals.square -= self.gradient.dot(&by_gradient);
        let next = Self {
            information: Matrix6::identity() * stiffness - inverse * (tie * tie),
            gradient: by_gradient * tie,
            cross: by_cross.into_iter().map(|(a, cross)| (a, cross * tie)).collect(),
        };
        Some((Solved { looks, information, gradient: self.gradient, tie, stiffness, own }, next))
    }
}

/// Whether the next look is added with the one before: of one image, or at one label if images have no errors for themselves.
fn is_alike(a: &Look, b: &Look) -> bool {
    if a.own_sigma == Sigmas::NONE {
        a.label == b.label && b.own_sigma == Sigmas::NONE && a.drift_sigma == b.drift_sigma
    } else {
        a.image == b.image
    }
}

/// How many looks, from the first one on, share one drift: anything that knows how far its pass had driven, m.
fn segment_length<T>(looks: &[T], driven_m: impl Fn(&T) -> f64) -> usize {
    let is_far = |look: &T| (driven_m(look) - driven_m(&looks[0])).abs() > SEGMENT_M;
    looks.iter().position(is_far).unwrap_or(looks.len())
}

/// The looks of a visit that share one drift each: anything that knows how far its pass had driven, m.
pub fn segments<T>(mut looks: &[T], driven_m: impl Fn(&T) -> f64) -> impl Iterator<Item = &[T]> {
    std::iter::from_fn(move || {
        let (segment, rest) = looks.split_at(segment_length(looks, &driven_m));
        looks = rest;
        (!segment.is_empty()).then_some(segment)
    })
}
