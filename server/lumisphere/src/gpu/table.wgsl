// Twin of table.rs: where a table's element is in its texture.

const ROW_BITS: u32 = 12u;

fn place_of(element: u32) -> vec2<u32> {
    return vec2(element & ((1u << ROW_BITS) - 1u), element >> ROW_BITS);
}
