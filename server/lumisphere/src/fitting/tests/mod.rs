//! What the fits reach and how they fail, on texels whose truth is known. Bounds are those of the measurements that the method was chosen
//! by, unless a test says otherwise.

mod cases;
mod damage;
mod lights;
#[cfg(feature = "gpu")]
mod on_device;
mod selection;
mod suggest;
mod views;
