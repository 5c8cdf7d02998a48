//! Between nalgebra and rapier's own vector and pose types.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};
use rapier3d::prelude as rp;

pub(crate) fn vector(v: &Vector3<f64>) -> rp::Vector {
    rp::Vector::new(v.x, v.y, v.z)
}

pub(crate) fn nalgebra_vector(v: &rp::Vector) -> Vector3<f64> {
    Vector3::new(v.x, v.y, v.z)
}

pub(crate) fn pose(iso: &Isometry3<f64>) -> rp::Pose {
    let q = iso.rotation.quaternion();
    rp::Pose::from_parts(
        vector(&iso.translation.vector),
        rp::Rotation::from_xyzw(q.i, q.j, q.k, q.w),
    )
}

pub(crate) fn isometry(pose: &rp::Pose) -> Isometry3<f64> {
    let r = pose.rotation;
    Isometry3::from_parts(
        Translation3::from(nalgebra_vector(&pose.translation)),
        UnitQuaternion::new_unchecked(Quaternion::new(r.w, r.x, r.y, r.z)),
    )
}
