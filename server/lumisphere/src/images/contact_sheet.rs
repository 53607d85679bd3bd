//! Contact sheet: equally sized pictures in a grid, row by row, for a person to see them side by side.

use super::{Image, ImageError, Rgb8};

/// Pixels of background between neighbours, not around the sheet.
const GAP_PX: usize = 4;
const BACKGROUND: [u8; 3] = [32; 3];

/// One 8-bit picture of all, `columns` to a row (at least 1; a sheet narrower than that is as wide as its pictures), on dark grey.
pub fn contact_sheet(pictures: &[Rgb8], columns: usize) -> Result<Rgb8, ImageError> {
    let sizes = pictures.iter().map(|picture| (picture.width, picture.height));
    let grid = Grid::new(sizes, columns)?;
    let (width, height) = grid.size();
    let mut sheet = Rgb8::filled(width, height, BACKGROUND);
    for (index, picture) in pictures.iter().enumerate() {
        let (left, top) = grid.origin(index);
        for (row, bytes) in picture.bytes.chunks_exact(3 * picture.width).enumerate() {
            let start = 3 * ((top + row) * width + left);
            sheet.bytes[start..start + bytes.len()].copy_from_slice(bytes);
        }
    }
    Ok(sheet)
}

/// The same of linear images with equally many planes; the background is 0.
pub fn contact_sheet_linear(pictures: &[Image], columns: usize) -> Result<Image, ImageError> {
    let grid = Grid::new(pictures.iter().map(|picture| (picture.width, picture.height)), columns)?;
    let channels = pictures[0].channels();
    if let Some(other) = pictures.iter().find(|picture| picture.channels() != channels) {
        return Err(ImageError::Shape { expected: format!("{channels} planes"), actual: format!("{} planes", other.channels()) });
    }
    let (width, height) = grid.size();
    let mut sheet = Image::zeros(width, height, channels);
    for (index, picture) in pictures.iter().enumerate() {
        let (left, top) = grid.origin(index);
        for (target, source) in sheet.planes.iter_mut().zip(&picture.planes) {
            for (row, samples) in source.chunks_exact(picture.width).enumerate() {
                let start = (top + row) * width + left;
                target[start..start + samples.len()].copy_from_slice(samples);
            }
        }
    }
    Ok(sheet)
}

struct Grid {
    cell: (usize, usize),
    columns: usize,
    rows: usize,
}

impl Grid {
    fn new(mut sizes: impl ExactSizeIterator<Item = (usize, usize)>, columns: usize) -> Result<Self, ImageError> {
        let count = sizes.len();
        let Some(cell) = sizes.next().filter(|&(width, height)| columns > 0 && width > 0 && height > 0) else {
            return Err(ImageError::Shape { expected: "at least one picture, pixel and column".into(), actual: "none".into() });
        };
        if let Some((width, height)) = sizes.find(|&size| size != cell) {
            return Err(ImageError::Shape { expected: format!("{} × {}", cell.0, cell.1), actual: format!("{width} × {height}") });
        }
        let columns = columns.min(count);
        Ok(Self { cell, columns, rows: count.div_ceil(columns) })
    }

    fn size(&self) -> (usize, usize) {
        (self.columns * (self.cell.0 + GAP_PX) - GAP_PX, self.rows * (self.cell.1 + GAP_PX) - GAP_PX)
    }

    fn origin(&self, index: usize) -> (usize, usize) {
        (index % self.columns * (self.cell.0 + GAP_PX), index / self.columns * (self.cell.1 + GAP_PX))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_stand_row_by_row_with_background_between() {
        let pictures: Vec<_> = (1..=3).map(|shade| Rgb8::filled(5, 2, [shade * 50; 3])).collect();
        let sheet = contact_sheet(&pictures, 2).unwrap();
        assert_eq!((sheet.width, sheet.height), (2 * 5 + GAP_PX, 2 * 2 + GAP_PX));
        assert_eq!(sheet.pixel(4, 1), [50; 3]);
        assert_eq!(sheet.pixel(5, 0), BACKGROUND);
        assert_eq!(sheet.pixel(5 + GAP_PX, 0), [100; 3]);
        assert_eq!(sheet.pixel(0, 2 + GAP_PX), [150; 3]);
        assert_eq!(sheet.pixel(5 + GAP_PX, 2 + GAP_PX), BACKGROUND);
    }

    #[test]
    fn linear_pictures_land_in_the_same_places() {
        let pictures: Vec<_> = (1..=3).map(|shade| Rgb8::filled(3, 4, [shade * 80; 3])).collect();
        let linear: Vec<_> = pictures.iter().map(Rgb8::to_linear).collect();
        let (sheet, codes) = (contact_sheet_linear(&linear, 2).unwrap(), contact_sheet(&pictures, 2).unwrap());
        for (index, sample) in codes.to_linear().planes[0].iter().enumerate() {
            let is_background = codes.bytes[3 * index] == BACKGROUND[0];
            assert_eq!(sheet.planes[0][index], if is_background { 0.0 } else { *sample });
        }
    }

    #[test]
    fn unequal_or_missing_pictures_are_typed_errors() {
        let pictures = [Rgb8::filled(5, 2, [1; 3]), Rgb8::filled(2, 5, [1; 3])];
        assert!(matches!(contact_sheet(&pictures, 2), Err(ImageError::Shape { .. })));
        assert!(matches!(contact_sheet(&[], 2), Err(ImageError::Shape { .. })));
        assert!(matches!(contact_sheet(&pictures[..1], 0), Err(ImageError::Shape { .. })));
        let planes = [Image::zeros(2, 2, 3), Image::zeros(2, 2, 4)];
        assert!(matches!(contact_sheet_linear(&planes, 2), Err(ImageError::Shape { .. })));
    }
}
