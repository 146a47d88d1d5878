//! What looks tell of a position, where they do not tell all of it.
//!
//! Looks from one place, as of a car that stands or a camera on a mast, tell no distance; rounding gives it an information all the same, of either
//! sign. Along an axis that is not told there is nothing that takes freedom from residuals, and nothing to disagree about.

use nalgebra::{Cholesky, Matrix3, SymmetricEigen, U3, Vector3};

/// An axis whose information is a smaller share of the largest is not told: from places that are a thirty-thousandth of the distance apart. Rounding leaves a
/// millionth of that.
const LEAST_SHARE: f64 = 1e-9;

/// Information of a position, along the axes that it tells.
pub enum Told {
    /// All three.
    All(Cholesky<f64, U3>),
    /// Unit vectors along those that are told, each with its information.
    Part(Vec<(Vector3<f64>, f64)>),
}

impl Told {
    /// Nothing if it is no number, or tells nothing.
    #[must_use]
    pub fn of(information: &Matrix3<f64>) -> Option<Self> {
        // The least eigenvalue is no smaller than that share if the determinant is not: most are told at a glance.
        if information.determinant() > LEAST_SHARE * information.trace().powi(3) {
            return information.cholesky().map(Self::All);
        }
        if !information.iter().all(|number| number.is_finite()) {
            return None;
        }
        let SymmetricEigen { eigenvalues, eigenvectors } = information.symmetric_eigen();
        let least = LEAST_SHARE * eigenvalues.max();
        let axes = eigenvectors.column_iter().zip(&eigenvalues).filter(|(_, of_axis)| **of_axis > least);
        let axes: Vec<_> = axes.map(|(axis, of_axis)| (axis.into_owned(), *of_axis)).collect();
        match axes.len() {
            0 => None,
            3 => information.cholesky().map(Self::All),
            _ => Some(Self::Part(axes)),
        }
    }

    /// How many axes are told.
    #[must_use]
    pub fn axes(&self) -> u32 {
        match self {
            Self::All(_) => 3,
            Self::Part(axes) => axes.len() as u32,
        }
    }

    /// The logarithm of the determinant of the information along them.
    #[must_use]
    pub fn ln_determinant(&self) -> f64 {
        match self {
            Self::All(cholesky) => 2.0 * cholesky.l_dirty().diagonal().iter().map(|d| d.ln()).sum::<f64>(),
            Self::Part(axes) => axes.iter().map(|(_, of_axis)| of_axis.ln()).sum(),
        }
    }

    /// The step along them that has this gradient.
    #[must_use]
    pub fn solve(&self, gradient: &Vector3<f64>) -> Vector3<f64> {
        match self {
            Self::All(cholesky) => cholesky.solve(gradient),
            Self::Part(axes) => axes.iter().map(|(axis, of_axis)| axis * (axis.dot(gradient) / of_axis)).sum(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_axis_that_rounding_alone_tells_is_not_told() -> Result<(), &'static str> {
        // Looks along (1, 2, 3), with what rounding leaves along it.
        let along = Vector3::new(1.0, 2.0, 3.0).normalize();
        let across = Matrix3::identity() - along * along.transpose();
        let gradient = Vector3::new(0.3, -0.7, 0.2);
        for rounding in [1e-14, -1e-14, 0.0] {
            let told = Told::of(&(4.0 * across + rounding * along * along.transpose())).ok_or("nothing is told")?;
            assert_eq!(told.axes(), 2);
            assert!((told.ln_determinant() - 2.0 * 4.0_f64.ln()).abs() < 1e-12);
            assert!((told.solve(&gradient) - across * gradient / 4.0).norm() < 1e-12);
        }
        Ok(())
    }

    #[test]
    fn what_is_told_is_as_by_cholesky() -> Result<(), &'static str> {
        let gradient = Vector3::new(0.3, -0.7, 0.2);
        for share in [1.0, 1e-4, 1e-8] {
            let information = Matrix3::new(5.0, 1.0, 0.0, 1.0, 4.0, 0.0, 0.0, 0.0, 5.0 * share);
            let told = Told::of(&information).ok_or("nothing is told")?;
            let cholesky = information.cholesky().ok_or("not positive")?;
            assert_eq!((told.axes(), told.solve(&gradient)), (3, cholesky.solve(&gradient)));
            assert!((told.ln_determinant() - information.determinant().ln()).abs() < 1e-9);
        }
        Ok(())
    }

    #[test]
    fn nothing_tells_nothing() {
        assert!(Told::of(&Matrix3::zeros()).is_none());
        assert!(Told::of(&Matrix3::from_element(f64::NAN)).is_none());
    }
}
