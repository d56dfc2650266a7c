//! Arrays in, and rows out: points, voxels and states as numpy has them.
//!
//! What is read is copied piece by piece, from any strides, so that a call neither needs a contiguous array nor holds
//! a second one. The GIL is not held meanwhile. If another thread writes to the array in that time, some of the
//! numbers are old and some new; each of them is a number all the same, and every number is checked where it is used.

use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyArrayDescrMethods, PyArrayMethods, PyUntypedArray,
    PyUntypedArrayMethods, dtype,
};
use pyo3::prelude::*;
use pyo3::types::IntoPyDict;

use flockmap::{State, Voxel};

use crate::errors::Error;

/// Points that are copied and worked on at a time: what fits a first-level cache.
const CHUNK: usize = 512;

#[derive(Clone, Copy)]
enum Kind {
    F32,
    F64,
}

/// (N, 3) numbers in an array that somebody else owns.
pub(crate) struct Points {
    start: *const u8,
    /// Bytes from a row to the next, and from a column to the next.
    strides: [isize; 2],
    len: usize,
    kind: Kind,
    /// Keeps the memory alive: numpy does not move that of an array that something refers to.
    _owner: Py<PyAny>,
}

// SAFETY: the pointer is only read through, the owner keeps what it points to, and Py is Send and Sync.
unsafe impl Send for Points {}
// SAFETY: as above.
unsafe impl Sync for Points {}

impl Points {
    /// Takes a numpy array of float32 or float64 of shape (N, 3), or what numpy makes one of, such as a list.
    pub(crate) fn new(what: &str, given: &Bound<'_, PyAny>) -> PyResult<Self> {
        let py = given.py();
        let array = as_array(what, given)?;
        let wrong = |found: String| {
            Error::new_err(format!("{what}: {found}, expected float32 or float64 numbers of shape (N, 3)"))
        };
        let kind = if array.dtype().is_equiv_to(&dtype::<f64>(py)) {
            Kind::F64
        } else if array.dtype().is_equiv_to(&dtype::<f32>(py)) {
            Kind::F32
        } else {
            return Err(wrong(format!("an array of {}", array.dtype())));
        };
        let shape = array.shape();
        if shape == [0] {
            // An empty list.
            return Ok(Self {
                start: std::ptr::null(),
                strides: [0; 2],
                len: 0,
                kind,
                _owner: given.clone().unbind(),
            });
        }
        let (&[len, 3], &[row, column]) = (shape, array.strides()) else {
            return Err(wrong(format!("an array of shape {}", shape_text(shape))));
        };
        // SAFETY: the array lives, and its header may be read while the GIL is held.
        let start = unsafe { (*array.as_array_ptr()).fields.data.cast::<u8>().cast_const() };
        Ok(Self { start, strides: [row, column], len, kind, _owner: array.into_any().unbind() })
    }

    /// A single point, of shape (3,), or as many as there are.
    pub(crate) fn one_or_many(what: &str, given: &Bound<'_, PyAny>) -> PyResult<(Self, bool)> {
        let array = as_array(what, given)?;
        if array.shape() == [3] {
            let row = array.call_method1("reshape", ((1, 3),))?;
            return Ok((Self::new(what, &row)?, true));
        }
        Ok((Self::new(what, &array)?, false))
    }

    pub(crate) const fn len(&self) -> usize {
        self.len
    }

    /// Copies the points from number `first` on.
    fn copy<T>(&self, first: usize, to: &mut [[T; 3]], convert: impl Fn(Number) -> T) {
        assert!(first + to.len() <= self.len, "beyond the end of the points");
        let [row, column] = self.strides;
        for (at, point) in to.iter_mut().enumerate() {
            for (axis, number) in point.iter_mut().enumerate() {
                let offset = (first + at) as isize * row + axis as isize * column;
                // SAFETY: row and column lie within the array, which lives as long as `_owner`; its header said where
                // its elements are, and they may stand anywhere, so they are read as not aligned.
                let found = unsafe {
                    let place = self.start.offset(offset);
                    match self.kind {
                        Kind::F32 => Number::F32(place.cast::<f32>().read_unaligned()),
                        Kind::F64 => Number::F64(place.cast::<f64>().read_unaligned()),
                    }
                };
                *number = convert(found);
            }
        }
    }

    /// All of them, as a scan has them.
    pub(crate) fn to_f32(&self) -> Vec<[f32; 3]> {
        let mut points = vec![[0.0; 3]; self.len];
        self.copy(0, &mut points, |number| match number {
            Number::F32(number) => number,
            Number::F64(number) => number as f32,
        });
        points
    }

    /// All of them.
    pub(crate) fn to_f64(&self) -> Vec<[f64; 3]> {
        let mut points = vec![[0.0; 3]; self.len];
        self.copy(0, &mut points, Number::f64);
        points
    }

    /// Gives all of them, some hundred at a time, with a part of the results of the same length.
    pub(crate) fn chunks<R>(&self, results: &mut [R], mut work: impl FnMut(&[[f64; 3]], &mut [R])) {
        let mut buffer = [[0.0; 3]; CHUNK];
        for (number, results) in results.chunks_mut(CHUNK).enumerate() {
            let points = &mut buffer[..results.len()];
            self.copy(number * CHUNK, points, Number::f64);
            work(points, results);
        }
    }
}

enum Number {
    F32(f32),
    F64(f64),
}

impl Number {
    fn f64(self) -> f64 {
        match self {
            Self::F32(number) => number.into(),
            Self::F64(number) => number,
        }
    }
}

/// What numpy makes of it.
fn as_array<'py>(what: &str, given: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyUntypedArray>> {
    if let Ok(array) = given.cast::<PyUntypedArray>() {
        return Ok(array.clone());
    }
    let py = given.py();
    let options = [("dtype", "float64")].into_py_dict(py)?;
    let made = py.import("numpy")?.call_method("asarray", (given,), Some(&options));
    let made =
        made.map_err(|error| Error::new_err(format!("{what}: {}, expected numbers", error.value(py))))?;
    made.cast_into::<PyUntypedArray>()
        .map_err(|_| Error::new_err(format!("{what}: no array, expected numbers")))
}

/// Three numbers, such as a position in metres.
pub(crate) fn triple(what: &str, given: &Bound<'_, PyAny>) -> PyResult<[f64; 3]> {
    let (points, is_one) = Points::one_or_many(what, given)?;
    match &points.to_f64()[..] {
        [point] if is_one => Ok(*point),
        _ => Err(Error::new_err(format!("{what}: an array of {} points, expected 3 numbers", points.len()))),
    }
}

/// The numbers of a square of so many rows and columns.
pub(crate) fn matrix<const N: usize>(what: &str, given: &Bound<'_, PyAny>) -> PyResult<[[f64; N]; N]> {
    let py = given.py();
    let array = as_array(what, given)?;
    if array.shape() != [N, N] {
        let shape = shape_text(array.shape());
        return Err(Error::new_err(format!("{what}: an array of shape {shape}, expected ({N}, {N})")));
    }
    let numbers = array.call_method1("astype", ("float64",)).and_then(|array| array.call_method0("ravel"));
    let numbers = numbers.and_then(|numbers| numbers.extract::<Vec<f64>>());
    let numbers = numbers
        .map_err(|error| Error::new_err(format!("{what}: {}, expected float64 numbers", error.value(py))))?;
    Ok(core::array::from_fn(|row| core::array::from_fn(|column| numbers[row * N + column])))
}

/// Whole numbers as numpy's int64.
fn whole<'py>(what: &str, given: &Bound<'py, PyAny>, expected: &str) -> PyResult<Bound<'py, PyAny>> {
    let py = given.py();
    let wrong = |found: String| Error::new_err(format!("{what}: {found}, expected {expected}"));
    let array = py.import("numpy")?.call_method1("asarray", (given,));
    let array = array.map_err(|error| wrong(error.value(py).to_string()))?;
    let array = array.cast_into::<PyUntypedArray>().map_err(|_| wrong("no array".into()))?;
    let dtype = array.dtype();
    let is_whole = dtype.kind() == b'i' || (dtype.kind() == b'u' && dtype.itemsize() < 8) || array.is_empty();
    if !is_whole {
        return Err(wrong(format!("an array of {dtype}")));
    }
    array.call_method1("astype", ("int64",))
}

/// Indices of voxels: whole numbers of shape (N, 3).
fn voxels(what: &str, given: &Bound<'_, PyAny>) -> PyResult<Vec<Voxel>> {
    const EXPECTED: &str = "whole numbers of shape (N, 3) within 32 bits";
    let array = whole(what, given, EXPECTED)?;
    let shape = array.cast::<PyUntypedArray>()?.shape().to_vec();
    if shape == [0] {
        return Ok(Vec::new());
    }
    let &[_, 3] = &shape[..] else {
        let shape = shape_text(&shape);
        return Err(Error::new_err(format!("{what}: an array of shape {shape}, expected {EXPECTED}")));
    };
    let numbers = array.call_method0("ravel")?.cast_into::<PyArray1<i64>>()?.to_vec()?;
    let index = |number: i64| {
        i32::try_from(number)
            .map_err(|_| Error::new_err(format!("{what}: an index of {number}, expected {EXPECTED}")))
    };
    let (rows, _) = numbers.as_chunks::<3>();
    rows.iter().map(|&[x, y, z]| Ok(Voxel::new(index(x)?, index(y)?, index(z)?))).collect()
}

/// States of voxels: 0 Unknown, 1 Free, 2 Occupied, in any shape. Given in the order of memory of Fortran, so the
/// first axis runs fastest; with the shape.
pub(crate) fn states(what: &str, given: &Bound<'_, PyAny>) -> PyResult<(Vec<usize>, Vec<State>)> {
    const EXPECTED: &str = "0 for Unknown, 1 for Free, 2 for Occupied";
    let array = whole(what, given, EXPECTED)?;
    let shape = array.cast::<PyUntypedArray>()?.shape().to_vec();
    let numbers = array.call_method1("ravel", ("F",))?.cast_into::<PyArray1<i64>>()?.to_vec()?;
    let state = |number: i64| match number {
        0 => Ok(State::Unknown),
        1 => Ok(State::Free),
        2 => Ok(State::Occupied),
        other => Err(Error::new_err(format!("{what}: a state of {other}, expected {EXPECTED}"))),
    };
    Ok((shape, numbers.into_iter().map(state).collect::<PyResult<_>>()?))
}

/// Indices of voxels, (N, 3), and a state for each, (N,).
pub(crate) fn voxels_with_states(
    indices: &Bound<'_, PyAny>,
    given: &Bound<'_, PyAny>,
) -> PyResult<Vec<(Voxel, State)>> {
    let voxels = voxels("indices", indices)?;
    let (shape, states) = states("states", given)?;
    if shape != [voxels.len()] {
        let text = format!("states: shape {shape:?}, expected [{}] as there are indices", voxels.len());
        return Err(Error::new_err(text));
    }
    Ok(voxels.into_iter().zip(states).collect())
}

/// Rows of three as an array of (N, 3), without a copy.
pub(crate) fn rows<T: numpy::Element>(py: Python<'_>, rows: Vec<[T; 3]>) -> PyResult<Bound<'_, PyArray2<T>>> {
    let count = rows.len();
    rows.into_flattened().into_pyarray(py).reshape([count, 3])
}

/// The number of a state in arrays.
pub(crate) const fn number_of(state: State) -> u8 {
    match state {
        State::Unknown => 0,
        State::Free => 1,
        State::Occupied => 2,
    }
}

fn shape_text(shape: &[usize]) -> String {
    match shape {
        [one] => format!("({one},)"),
        all => format!("({})", all.iter().map(usize::to_string).collect::<Vec<_>>().join(", ")),
    }
}
