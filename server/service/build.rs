//! The viewer's files lie in the binary: a change of any makes it anew.

fn main() {
    println!("cargo:rerun-if-changed=../../client/web/dist");
}
