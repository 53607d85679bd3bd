//! Accessors: typed arrays in a glTF file's buffers, every bound checked before anything is read.

use super::{FormatError, Reader, json, wrong};

impl Reader<'_> {
    // Bytes of a buffer view and its stride.
    pub(super) fn view(&self, index: usize) -> Result<(&[u8], Option<usize>), FormatError> {
        let outside = || wrong(format!("buffer view {index} lies outside its buffer"));
        let view = self.root.buffer_views.get(index).ok_or_else(outside)?;
        let start = usize::try_from(view.byte_offset.map_or(0, |o| o.0)).map_err(|_| outside())?;
        let length = usize::try_from(view.byte_length.0).map_err(|_| outside())?;
        let buffer = self.buffers.get(view.buffer.value()).ok_or_else(outside)?;
        let bytes = start.checked_add(length).and_then(|end| buffer.get(start..end)).ok_or_else(outside)?;
        Ok((bytes, view.byte_stride.map(|s| s.0)))
    }

    // Elements of an accessor: (bytes, stride, count, component type, normalised). Every element lies inside the bytes.
    fn elements(&self, index: usize, dimension: usize) -> Result<Elements<'_>, FormatError> {
        use json::validation::Checked::Valid;
        let broken = |what: &str| wrong(format!("accessor {index} {what}"));
        let accessor = self.root.accessors.get(index).ok_or_else(|| broken("does not exist"))?;
        if accessor.sparse.is_some() {
            return Err(broken("is sparse, which is not supported"));
        }
        let (Valid(component), Valid(shape)) = (accessor.component_type, accessor.type_) else {
            return Err(broken("has an unknown type"));
        };
        if shape.multiplicity() != dimension {
            return Err(broken(&format!("has {} components, {dimension} expected", shape.multiplicity())));
        }
        let view = accessor.buffer_view.ok_or_else(|| broken("has no data"))?;
        let (bytes, stride) = self.view(view.value())?;
        let size = component.0.size() * dimension;
        let stride = stride.unwrap_or(size);
        let outside = || broken("reaches beyond its buffer view");
        let start = usize::try_from(accessor.byte_offset.map_or(0, |o| o.0)).map_err(|_| outside())?;
        let count = usize::try_from(accessor.count.0).map_err(|_| outside())?;
        let last = count.checked_sub(1).ok_or_else(|| broken("is empty"))?;
        let end = last.checked_mul(stride).and_then(|l| l.checked_add(size)).and_then(|l| l.checked_add(start)).ok_or_else(outside)?;
        if stride < size || end > bytes.len() {
            return Err(outside());
        }
        Ok(Elements { bytes: &bytes[start..], stride, count, component: component.0, normalized: accessor.normalized })
    }

    pub(super) fn floats<const N: usize>(&self, index: usize) -> Result<Vec<[f32; N]>, FormatError> {
        let elements = self.elements(index, N)?;
        let size = elements.component.size();
        let mut values = Vec::with_capacity(elements.count);
        for i in 0..elements.count {
            let mut value = [0.0; N];
            for (k, v) in value.iter_mut().enumerate() {
                *v = elements.float(i * elements.stride + k * size);
            }
            values.push(value);
        }
        Ok(values)
    }

    pub(super) fn indices(&self, index: usize) -> Result<Vec<u32>, FormatError> {
        use json::accessor::ComponentType;
        let elements = self.elements(index, 1)?;
        let at = |i: usize| &elements.bytes[i * elements.stride..];
        let all = 0..elements.count;
        match elements.component {
            ComponentType::U8 => Ok(all.map(|i| at(i)[0] as u32).collect()),
            ComponentType::U16 => Ok(all.map(|i| u16::from_le_bytes([at(i)[0], at(i)[1]]) as u32).collect()),
            ComponentType::U32 => Ok(all.map(|i| u32::from_le_bytes([at(i)[0], at(i)[1], at(i)[2], at(i)[3]])).collect()),
            _ => Err(wrong(format!("accessor {index} does not hold indices"))),
        }
    }
}

struct Elements<'a> {
    bytes: &'a [u8],
    stride: usize,
    count: usize,
    component: json::accessor::ComponentType,
    normalized: bool,
}

impl Elements<'_> {
    // The component at a byte offset, which `Reader::elements` has checked.
    fn float(&self, at: usize) -> f32 {
        use json::accessor::ComponentType;
        let b = &self.bytes[at..];
        let (value, largest) = match self.component {
            ComponentType::F32 => return f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
            ComponentType::I8 => (b[0] as i8 as f32, i8::MAX as f32),
            ComponentType::U8 => (b[0] as f32, u8::MAX as f32),
            ComponentType::I16 => (i16::from_le_bytes([b[0], b[1]]) as f32, i16::MAX as f32),
            ComponentType::U16 => (u16::from_le_bytes([b[0], b[1]]) as f32, u16::MAX as f32),
            ComponentType::U32 => (u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as f32, u32::MAX as f32),
        };
        if self.normalized { (value / largest).max(-1.0) } else { value }
    }
}
