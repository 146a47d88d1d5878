//! A detection as the core sees it: a local pinhole along its viewing ray.

use nalgebra::{Matrix3, RowVector3, Vector3};

/// All rays of a data set, one a detection, ordered by detection id.
#[derive(Debug, Default, Clone)]
pub struct Rays {
    /// The rays themselves.
    pub rays: Vec<Ray>,
    /// The image of each ray.
    pub image: Vec<u32>,
    /// The class of each ray; rays of different classes have nothing to do with each other.
    pub class: Vec<u32>,
}

/// One detection's viewing ray in the world, with the projection around it.
///
/// With `(a, b, c) = residual_from_world * (X - center)`, the reprojection error of a world point `X` is
/// `(a / c, b / c)` in pixels and `c` is its depth in metres; `c > 0` is in front.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// The 3x3 matrix above.
    pub residual_from_world: Matrix3<f64>,
    /// Camera centre in the world, m.
    pub center: Vector3<f64>,
    /// Unit viewing direction in the world.
    pub direction: Vector3<f64>,
}

impl Ray {
    /// The ray of a detection of a camera: the matrix and the direction are given in its axes.
    #[must_use]
    pub fn of_camera(
        residual_from_cam: &Matrix3<f64>,
        direction_in_cam: Vector3<f64>,
        cam_from_world: &Matrix3<f64>,
        center: Vector3<f64>,
    ) -> Self {
        Self {
            residual_from_world: residual_from_cam * cam_from_world,
            center,
            direction: cam_from_world.tr_mul(&direction_in_cam),
        }
    }

    /// `(a, b, c)` of a world point.
    #[inline]
    #[must_use]
    pub fn project(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.residual_from_world * (point - self.center)
    }

    /// Squared reprojection error in px², or infinity for a point that is not in front.
    #[inline]
    #[must_use]
    pub fn squared_error(&self, point: &Vector3<f64>) -> f64 {
        let p = self.project(point);
        if p.z > 0.0 { (p.x * p.x + p.y * p.y) / (p.z * p.z) } else { f64::INFINITY }
    }

    /// Residual `(a / c, b / c)` and its two rows of derivatives by the point, or nothing behind the camera.
    #[inline]
    #[must_use]
    pub fn linearize(&self, point: &Vector3<f64>) -> Option<([f64; 2], [RowVector3<f64>; 2])> {
        self.linearize_at(&self.project(point))
    }

    /// The same of a point with this `(a, b, c)`.
    #[inline]
    #[must_use]
    pub fn linearize_at(&self, p: &Vector3<f64>) -> Option<([f64; 2], [RowVector3<f64>; 2])> {
        self.linearize_beside(p, 0.0)
    }

    /// The same if a share of the residual comes from the camera being elsewhere. The point is looked at along the line from where the camera
    /// is, and moving it along that line changes nothing: the rows are those of the line to the point, turned by this share of the residual
    /// towards the ray.
    #[inline]
    #[must_use]
    pub fn linearize_beside(
        &self,
        p: &Vector3<f64>,
        share_of_position: f64,
    ) -> Option<([f64; 2], [RowVector3<f64>; 2])> {
        (p.z > 0.0).then(|| self.linearize_in_front(p, share_of_position))
    }

    /// The same of a point that is in front of the camera.
    #[inline]
    #[must_use]
    pub fn linearize_in_front(&self, p: &Vector3<f64>, share_of_position: f64) -> ([f64; 2], [RowVector3<f64>; 2]) {
        let inverse = 1.0 / p.z;
        let residual = [p.x * inverse, p.y * inverse];
        let m = &self.residual_from_world;
        let depth_row = m.row(2) * (1.0 - share_of_position);
        (residual, [(m.row(0) - depth_row * residual[0]) * inverse, (m.row(1) - depth_row * residual[1]) * inverse])
    }

    /// The same ray in a world whose origin lies at `origin`.
    #[must_use]
    pub fn relative_to(&self, origin: &Vector3<f64>) -> Self {
        Self { center: self.center - origin, ..*self }
    }

    /// Squared pixels that a unit of the virtual image plane spans, the mean of both axes.
    #[must_use]
    pub fn pixels_per_unit2(&self) -> f64 {
        let [x, y] = self.pixels_per_unit2_of_axes();
        0.5 * (x + y)
    }

    /// Squared pixels that a unit of the virtual image plane spans, horizontally and vertically in the picture.
    #[must_use]
    pub fn pixels_per_unit2_of_axes(&self) -> [f64; 2] {
        // The first two rows are J (V_12 - p_0 V_3) with V orthonormal: without their part along V_3 they are J V_12.
        let depth = self.residual_from_world.row(2);
        let rows = [0, 1].map(|i| self.residual_from_world.row(i));
        rows.map(|row| (row - depth * row.dot(&depth)).norm_squared())
    }

    /// Whether the camera model has a ray for this detection: all numbers are finite.
    #[must_use]
    pub fn is_usable(&self) -> bool {
        self.residual_from_world.iter().chain(&self.center).all(|number| number.is_finite())
    }
}
