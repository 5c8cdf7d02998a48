//! Frames as types, and the points, directions and transforms that carry them.

use nalgebra::{Isometry3, Point3, Unit, UnitQuaternion, Vector3};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::{fmt, marker::PhantomData, ops::Mul};

/// A coordinate frame, known by name at compile time.
pub trait Frame: Copy + 'static {
    /// The frame's name as it appears in messages.
    const NAME: &'static str;
}

macro_rules! frames {
    ($($(#[$doc:meta])* $name:ident = $text:literal;)*) => {$(
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub struct $name;
        impl Frame for $name { const NAME: &'static str = $text; }
    )*};
}

frames! {
    /// The robot's own frame: camera models and targets are given in it.
    Rover = "rover";
    /// The arm's base frame (frame 0 of its Denavit-Hartenberg rows).
    ArmBase = "arm_base";
    /// The arm's last link frame, to which the instrument and the fiducial are fixed.
    Link = "link";
    /// The mast's head: x along the view, y left, z up with pan and tilt at zero; turns with both.
    MastHead = "mast_head";
    /// Where a mobile robot stood when it was started: origin at its rover frame's, x along its
    /// heading then, z up against gravity. What odometry reports is in it.
    Site = "site";
    /// The simulator's inertial frame; no service knows it.
    World = "world";
}

/// A position in frame `F`, metres.
#[derive(PartialEq)]
pub struct Point<F> {
    /// The coordinates, metres.
    pub coords: Vector3<f64>,
    frame: PhantomData<F>,
}

/// A unit direction in frame `F`.
#[derive(PartialEq)]
pub struct Direction<F> {
    /// The unit vector.
    pub unit: Unit<Vector3<f64>>,
    frame: PhantomData<F>,
}

/// The rigid transform that takes coordinates in `From` to coordinates in `To`.
#[derive(PartialEq)]
pub struct Transform<To, From> {
    /// Rotation and translation (metres) as nalgebra knows them.
    pub isometry: Isometry3<f64>,
    frames: PhantomData<(To, From)>,
}

impl<F> Clone for Point<F> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<F> Copy for Point<F> {}
impl<F> Clone for Direction<F> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<F> Copy for Direction<F> {}
impl<A, B> Clone for Transform<A, B> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<A, B> Copy for Transform<A, B> {}

impl<F: Frame> fmt::Debug for Point<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let c = &self.coords;
        write!(f, "[{} {} {}] m in {}", c.x, c.y, c.z, F::NAME)
    }
}
impl<F: Frame> fmt::Debug for Direction<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let c = &self.unit;
        write!(f, "[{} {} {}] in {}", c.x, c.y, c.z, F::NAME)
    }
}
impl<A: Frame, B: Frame> fmt::Debug for Transform<A, B> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}_from_{}: {}", A::NAME, B::NAME, self.isometry)
    }
}

impl<F> Point<F> {
    /// A point from its coordinates, metres.
    pub fn new(x: f64, y: f64, z: f64) -> Self {
        Self::from(Vector3::new(x, y, z))
    }

    /// The Euclidean distance to `other`, metres.
    pub fn distance(&self, other: &Self) -> f64 {
        (self.coords - other.coords).norm()
    }

    /// The point `distance_m` away along `direction`.
    pub fn offset(&self, direction: &Direction<F>, distance_m: f64) -> Self {
        Self::from(self.coords + direction.unit.into_inner() * distance_m)
    }
}

impl<F> From<Vector3<f64>> for Point<F> {
    fn from(coords: Vector3<f64>) -> Self {
        Self {
            coords,
            frame: PhantomData,
        }
    }
}

impl<F> Direction<F> {
    /// The direction of `v`; `None` for a zero or non-finite vector.
    pub fn new(v: Vector3<f64>) -> Option<Self> {
        let unit = Unit::try_new(v, 1e-12)?;
        unit.iter().all(|x| x.is_finite()).then_some(Self {
            unit,
            frame: PhantomData,
        })
    }

    /// The angle to `other`, radians, in `0..=pi`.
    pub fn angle(&self, other: &Self) -> f64 {
        let (a, b) = (self.unit.into_inner(), other.unit.into_inner());
        a.cross(&b).norm().atan2(a.dot(&b))
    }
}

impl<F> From<Unit<Vector3<f64>>> for Direction<F> {
    fn from(unit: Unit<Vector3<f64>>) -> Self {
        Self {
            unit,
            frame: PhantomData,
        }
    }
}

impl<F> std::ops::Neg for Direction<F> {
    type Output = Self;
    fn neg(self) -> Self {
        Self::from(-self.unit)
    }
}

impl<To, From> Transform<To, From> {
    /// The transform that changes nothing but the name of the frame.
    pub fn identity() -> Self {
        Isometry3::identity().into()
    }

    /// A transform from translation (metres) and fixed-axis roll, pitch, yaw (radians; the
    /// rotation is `Rz(yaw) Ry(pitch) Rx(roll)`).
    pub fn from_xyz_rpy(xyz_m: [f64; 3], rpy_rad: [f64; 3]) -> Self {
        let rotation = UnitQuaternion::from_euler_angles(rpy_rad[0], rpy_rad[1], rpy_rad[2]);
        Isometry3::from_parts(Vector3::from(xyz_m).into(), rotation).into()
    }

    /// The transform in the opposite direction.
    pub fn inverse(&self) -> Transform<From, To> {
        self.isometry.inverse().into()
    }
}

impl<To, From> std::convert::From<Isometry3<f64>> for Transform<To, From> {
    fn from(isometry: Isometry3<f64>) -> Self {
        Self {
            isometry,
            frames: PhantomData,
        }
    }
}

impl<A, B, C> Mul<Transform<B, C>> for Transform<A, B> {
    type Output = Transform<A, C>;
    fn mul(self, rhs: Transform<B, C>) -> Self::Output {
        (self.isometry * rhs.isometry).into()
    }
}

impl<A, B> Mul<Point<B>> for Transform<A, B> {
    type Output = Point<A>;
    fn mul(self, rhs: Point<B>) -> Self::Output {
        (self.isometry * Point3::from(rhs.coords)).coords.into()
    }
}

impl<A, B> Mul<Direction<B>> for Transform<A, B> {
    type Output = Direction<A>;
    fn mul(self, rhs: Direction<B>) -> Self::Output {
        (self.isometry.rotation * rhs.unit).into()
    }
}

impl<F> Serialize for Point<F> {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        <[f64; 3]>::from(self.coords).serialize(s)
    }
}
impl<'de, F> Deserialize<'de> for Point<F> {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        let xyz = <[f64; 3]>::deserialize(d)?;
        if xyz.iter().all(|x| x.is_finite()) {
            Ok(Vector3::from(xyz).into())
        } else {
            Err(serde::de::Error::custom(
                "a position must be three finite numbers, metres",
            ))
        }
    }
}
impl<F> Serialize for Direction<F> {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        <[f64; 3]>::from(self.unit.into_inner()).serialize(s)
    }
}
/// Accepts any non-zero finite vector and keeps a vector that is already of unit length bit for
/// bit, so that a direction survives any number of hops over the network unchanged.
impl<'de, F> Deserialize<'de> for Direction<F> {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        let v = Vector3::from(<[f64; 3]>::deserialize(d)?);
        if (v.norm() - 1.0).abs() < 1e-12 {
            return Ok(Unit::new_unchecked(v).into());
        }
        Direction::new(v).ok_or_else(|| {
            serde::de::Error::custom("a direction must be three finite numbers, not all zero")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inner_frame_names_cancel_in_a_product() {
        let rover_from_arm = Transform::<Rover, ArmBase>::from_xyz_rpy(
            [1.0, 2.0, 3.0],
            [0.0, 0.0, std::f64::consts::FRAC_PI_2],
        );
        let arm_from_link =
            Transform::<ArmBase, Link>::from_xyz_rpy([1.0, 0.0, 0.0], [0.0, 0.0, 0.0]);
        let tip_in_link = Point::<Link>::new(0.0, 1.0, 0.0);
        let tip_in_rover: Point<Rover> = rover_from_arm * arm_from_link * tip_in_link;
        assert!(tip_in_rover.distance(&Point::new(0.0, 3.0, 3.0)) < 1e-15);
        let back = (rover_from_arm * arm_from_link).inverse() * tip_in_rover;
        assert!(back.distance(&tip_in_link) < 1e-15);
    }

    #[test]
    fn a_zero_vector_is_no_direction() {
        assert!(Direction::<Rover>::new(Vector3::zeros()).is_none());
        assert!(Direction::<Rover>::new(Vector3::new(f64::NAN, 0.0, 1.0)).is_none());
    }
}
