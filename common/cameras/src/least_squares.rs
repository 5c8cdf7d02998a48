//! Levenberg-Marquardt over any state that can be moved by a vector.
//!
//! Damped normal equations with Marquardt's scaling, the damping adapted by the ratio of actual
//! to predicted decrease (H. B. Nielsen, "Damping parameter in Marquardt's method", 1999).

use nalgebra::{DMatrix, DVector};

/// The normal equations of a least-squares problem at one state.
pub(crate) struct Normal {
    /// `J^T W J`.
    pub(crate) hessian: DMatrix<f64>,
    /// `J^T W r`.
    pub(crate) gradient: DVector<f64>,
    /// Half the sum of (robust) squares.
    pub(crate) cost: f64,
}

/// A problem to be minimised.
pub(crate) trait Problem {
    type State: Clone;
    /// Half the sum of squares; `None` where the problem is not defined.
    fn cost(&self, state: &Self::State) -> Option<f64>;
    /// The normal equations; `None` where the problem is not defined.
    fn normal(&self, state: &Self::State) -> Option<Normal>;
    /// The state moved by a step.
    fn moved(&self, state: &Self::State, step: &DVector<f64>) -> Self::State;
}

/// Where the iteration ended.
pub(crate) struct Minimum<S> {
    pub(crate) state: S,
    pub(crate) cost: f64,
    pub(crate) iterations: u32,
    /// Whether it ended because nothing more was to be gained.
    pub(crate) settled: bool,
}

/// Relative decrease of the cost below which the iteration is settled.
const SETTLED: f64 = 1e-13;

/// Minimises from `start`; `None` if the problem is not defined there.
pub(crate) fn minimise<P: Problem>(
    problem: &P,
    start: P::State,
    max_iterations: u32,
) -> Option<Minimum<P::State>> {
    let mut state = start;
    let mut normal = problem.normal(&state)?;
    let mut damping = 1e-4;
    let mut growth = 2.0;
    let mut idle = 0;
    for iteration in 0..max_iterations {
        let mut damped = normal.hessian.clone();
        for i in 0..damped.nrows() {
            let d = damped[(i, i)];
            damped[(i, i)] = d + damping * d.max(1e-12);
        }
        let step = damped.cholesky().map(|c| c.solve(&(-&normal.gradient)));
        let trial = step
            .filter(|step| step.iter().all(|x| x.is_finite()))
            .and_then(|step| {
                let moved = problem.moved(&state, &step);
                let cost = problem.cost(&moved).filter(|c| c.is_finite())?;
                let model =
                    -(normal.gradient.dot(&step) + 0.5 * step.dot(&(&normal.hessian * &step)));
                Some((moved, cost, model))
            });
        let end = |settled| Minimum {
            state: state.clone(),
            cost: normal.cost,
            iterations: iteration,
            settled,
        };
        match trial {
            Some((moved, cost, model)) if cost < normal.cost => {
                let gained = normal.cost - cost;
                let ratio = gained / model.max(f64::MIN_POSITIVE);
                let small = gained <= SETTLED * normal.cost;
                let Some(next) = problem.normal(&moved) else {
                    damping *= growth;
                    growth *= 2.0;
                    continue;
                };
                state = moved;
                normal = next;
                damping *= (1.0 - (2.0 * ratio - 1.0).powi(3)).clamp(1.0 / 3.0, 2.0);
                damping = damping.max(1e-14);
                growth = 2.0;
                idle = if small { idle + 1 } else { 0 };
                if idle >= 2 {
                    return Some(Minimum {
                        cost: normal.cost,
                        state,
                        iterations: iteration + 1,
                        settled: true,
                    });
                }
            }
            Some((_, _, model)) if model <= SETTLED * normal.cost => return Some(end(true)),
            _ => {
                damping *= growth;
                growth *= 2.0;
                if damping > 1e16 {
                    return Some(end(true));
                }
            }
        }
    }
    Some(Minimum {
        cost: normal.cost,
        state,
        iterations: max_iterations,
        settled: false,
    })
}

/// A problem given by its residuals alone; their derivative is taken by central differences of
/// `steps`.
pub(crate) struct Differenced<F> {
    pub(crate) residuals: F,
    pub(crate) steps: DVector<f64>,
}

impl<F: Fn(&DVector<f64>) -> Option<DVector<f64>>> Problem for Differenced<F> {
    type State = DVector<f64>;

    fn cost(&self, state: &DVector<f64>) -> Option<f64> {
        Some(0.5 * (self.residuals)(state)?.norm_squared())
    }

    fn normal(&self, state: &DVector<f64>) -> Option<Normal> {
        let r = (self.residuals)(state)?;
        let mut jacobian = DMatrix::zeros(r.len(), state.len());
        for i in 0..state.len() {
            let side = |sign: f64| {
                let mut at = state.clone();
                at[i] += sign * self.steps[i];
                (self.residuals)(&at)
            };
            let column = (side(1.0)? - side(-1.0)?) / (2.0 * self.steps[i]);
            jacobian.set_column(i, &column);
        }
        Some(Normal {
            hessian: jacobian.tr_mul(&jacobian),
            gradient: jacobian.tr_mul(&r),
            cost: 0.5 * r.norm_squared(),
        })
    }

    fn moved(&self, state: &DVector<f64>, step: &DVector<f64>) -> DVector<f64> {
        state + step
    }
}
