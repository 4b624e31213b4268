//! Methods that RPF grew from and is compared with.

pub(crate) mod mean;
