//! Small least-squares problems.

use crate::MethodError;
use nalgebra::{Cholesky, DMatrix, DVector, SMatrix, SVector};

/// Solution of `a x = b` for a symmetric positive `a`, scaled by its diagonal first: the unknowns
/// mix metres, radians and pixels, and unscaled the condition number passes 1e12.
pub(crate) fn solve_scaled<const N: usize>(
    a: &SMatrix<f64, N, N>,
    b: &SVector<f64, N>,
    what: &'static str,
) -> Result<SVector<f64, N>, MethodError> {
    let scale = a.diagonal().map(|d| 1.0 / d.sqrt());
    let scaled = SMatrix::<f64, N, N>::from_fn(|i, j| a[(i, j)] * scale[i] * scale[j]);
    let factor = Cholesky::new(scaled).ok_or(MethodError::Degenerate { what })?;
    let x = factor.solve(&b.component_mul(&scale));
    finite_all(x.as_slice(), what)?;
    Ok(x.component_mul(&scale))
}

/// The same for a size that is known at run time.
pub(crate) fn solve_scaled_dynamic(
    a: &DMatrix<f64>,
    b: &DVector<f64>,
    what: &'static str,
) -> Result<DVector<f64>, MethodError> {
    let scale = a.diagonal().map(|d| 1.0 / d.sqrt());
    let scaled = DMatrix::from_fn(a.nrows(), a.ncols(), |i, j| a[(i, j)] * scale[i] * scale[j]);
    let factor = Cholesky::new(scaled).ok_or(MethodError::Degenerate { what })?;
    let x = factor.solve(&b.component_mul(&scale));
    finite_all(x.as_slice(), what)?;
    Ok(x.component_mul(&scale))
}

/// Least squares by the pseudo-inverse: singular values below 1e-10 of the largest count as zero.
pub(crate) fn least_squares(
    a: DMatrix<f64>,
    b: &DVector<f64>,
    what: &'static str,
) -> Result<DVector<f64>, MethodError> {
    let svd = a.svd(true, true);
    let least = 1e-10 * svd.singular_values.max();
    let x = svd
        .solve(b, least)
        .map_err(|_| MethodError::Degenerate { what })?;
    finite_all(x.as_slice(), what)?;
    Ok(x)
}

fn finite_all(x: &[f64], what: &'static str) -> Result<(), MethodError> {
    if x.iter().all(|v| v.is_finite()) {
        Ok(())
    } else {
        Err(MethodError::Degenerate { what })
    }
}
