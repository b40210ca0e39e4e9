/* Python module `_native`: argument checks and calls of the compiled kernels.

   All arrays hold doubles unless stated otherwise, components first and samples last, so that the samples of
   a component are contiguous. `native.py` allocates the outputs; `kinematics.py` and `qr.py` define each
   function in NumPy. Calls on long arrays release the global interpreter lock. */

#define Py_LIMITED_API 0x030b0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stdlib.h>

#include "samples.h"
#include "frames.h"
#include "jacobian.h"
#include "qr.h"

/* Expected array: name, number of axes, and type ('d' double, 'D' writable double, 's' size, '?' bool). */
typedef struct {
    const char *name;
    int axes;
    char type;
} ArraySpec;

/* Array whose last axis is contiguous; strides count items. */
typedef struct {
    Py_buffer view;
    void *data;
    Size stride[4];
} Array;

static void release(Array *a, Size count)
{
    while (count--)
        PyBuffer_Release(&a[count].view);
}

/* Get one array; return 0 and set the exception if it has another type or layout. */
static int get_array(Array *a, PyObject *from, ArraySpec spec)
{
    const int is_written = spec.type == 'D';
    if (PyObject_GetBuffer(from, &a->view, PyBUF_STRIDES | PyBUF_FORMAT | (is_written ? PyBUF_WRITABLE : 0)) <
        0)
        return 0;
    const Py_buffer *v = &a->view;
    const char *format = v->format ? v->format : "";
    const char *formats = spec.type == '?' ? "?" : spec.type == 's' ? "lqn" : "d";
    const Size size = spec.type == '?' ? 1 : 8;
    int ok = v->ndim == spec.axes && v->itemsize == size && *format && strchr(formats, *format);
    for (int i = 0; ok && i < v->ndim; i++) {
        a->stride[i] = v->strides[i] / size;
        ok = v->strides[i] % size == 0 && (i < v->ndim - 1 || a->stride[i] == 1 || v->shape[i] < 2);
    }
    a->data = v->buf;
    if (!ok) {
        PyErr_Format(PyExc_ValueError,
                     "%s: expected an array with %d axes, format %s and a contiguous last axis", spec.name,
                     spec.axes, formats);
        PyBuffer_Release(&a->view);
    }
    return ok;
}

/* Get all arguments; otherwise release those already taken, set the exception and return 0. */
static int get_arrays(Array *a, PyObject *args, const ArraySpec *specs, Size count)
{
    if (PyTuple_Size(args) != count) {
        PyErr_Format(PyExc_TypeError, "expected %zd arrays", count);
        return 0;
    }
    for (Size i = 0; i < count; i++)
        if (!get_array(a + i, PyTuple_GetItem(args, i), specs[i])) {
            release(a, i);
            return 0;
        }
    return 1;
}

/* Whether an array has this shape; dimensions beyond its number of axes are ignored. */
static int has_shape(const Array *a, Size first, Size second, Size third, Size fourth)
{
    const Size shape[] = {first, second, third, fourth};
    for (int i = 0; i < a->view.ndim; i++)
        if (a->view.shape[i] != shape[i])
            return 0;
    return 1;
}

/* Whether all axes are contiguous. */
static int is_contiguous(const Array *a)
{
    Size step = 1;
    for (int i = a->view.ndim; i--; step *= a->view.shape[i])
        if (a->stride[i] != step && a->view.shape[i] > 1)
            return 0;
    return 1;
}

/* Release all arrays and return None, or raise ValueError for inconsistent shapes. */
static PyObject *finish(Array *a, Size count, int ok)
{
    release(a, count);
    if (ok)
        Py_RETURN_NONE;
    if (!PyErr_Occurred())
        PyErr_SetString(PyExc_ValueError, "array shapes or indices are inconsistent");
    return NULL;
}

static PyObject *py_cos_sin(PyObject *self, PyObject *args)
{
    (void)self;
    static const ArraySpec specs[] = {{"angles", 2, 'd'}, {"cosines", 2, 'D'}, {"sines", 2, 'D'}};
    Array a[3];
    if (!get_arrays(a, args, specs, 3))
        return NULL;
    const Size k = a->view.shape[0], m = a->view.shape[1];
    int ok = is_contiguous(a);
    for (int i = 1; i < 3; i++)
        ok = ok && has_shape(a + i, k, m, 0, 0) && is_contiguous(a + i);
    if (ok) {
        Py_BEGIN_ALLOW_THREADS;
        sincos_batch(k * m, a->data, a[1].data, a[2].data);
        Py_END_ALLOW_THREADS;
    }
    return finish(a, 3, ok);
}

static PyObject *py_propagate_frames(PyObject *self, PyObject *args)
{
    (void)self;
    static const ArraySpec specs[] = {{"link_transforms", 4, 'd'}, {"prismatic", 1, '?'}, {"values", 2, 'd'},
                                      {"cosines", 2, 'd'},         {"sines", 2, 'd'},     {"frames", 4, 'D'}};
    Array a[6];
    if (!get_arrays(a, args, specs, 6))
        return NULL;
    const Array *link_transforms = a, *values = a + 2, *frames = a + 5;
    const Size b = link_transforms->view.shape[0], k = values->view.shape[0], n = values->view.shape[1],
               m = b ? n / b : 0;
    int ok = m * b == n && has_shape(link_transforms, b, k + 1, 4, 4) && has_shape(a + 1, k, 0, 0, 0) &&
             has_shape(a + 3, k, n, 0, 0) && has_shape(a + 4, k, n, 0, 0) &&
             has_shape(frames, k + 2, frames->view.shape[1], 3, n) && frames->view.shape[1] >= 4 &&
             frames->stride[1] == 3 * frames->stride[2];
    for (int i = 0; i < 5; i++)
        ok = ok && is_contiguous(a + i);
    if (ok) {
        Py_BEGIN_ALLOW_THREADS;
        /* Samples of member i start at i·m. */
        for (Size i = 0; i < b; i++)
            propagate_frames(k + 1, m, (double *)link_transforms->data + i * 16 * (k + 1), a[1].data,
                             (double *)values->data + i * m, (double *)a[3].data + i * m,
                             (double *)a[4].data + i * m, n, (double *)frames->data + i * m,
                             frames->stride[0], frames->stride[2]);
        Py_END_ALLOW_THREADS;
    }
    return finish(a, 6, ok);
}

/* Read error twists from frames (b, r, 3, n), point (3, n), bodies (p) and twists (p, 6) or (members, p, 6).
   */
static int get_error_twists(ErrorTwists *e, const Array *a)
{
    const Array *frames = a, *point = a + 1, *body = a + 2, *twists = a + 3;
    const Size p = body->view.shape[0], n = point->view.shape[1];
    int ok = has_shape(frames, frames->view.shape[0], frames->view.shape[1], 3, n) &&
             frames->view.shape[1] >= 4 && frames->stride[1] == 3 * frames->stride[2] &&
             has_shape(point, 3, n, 0, 0) && is_contiguous(twists);
    ok = ok && (twists->view.ndim == 2 ? has_shape(twists, p, 6, 0, 0)
                                       : has_shape(twists, twists->view.shape[0], p, 6, 0));
    const Size *bodies = body->data;
    for (Size i = 0; ok && i < p; i++)
        ok = bodies[i] >= 0 && bodies[i] < frames->view.shape[0];
    *e = (ErrorTwists){.count = p,
                       .n_ends = 1,
                       .end_offset = n,
                       .bodies = bodies,
                       .twists = twists->data,
                       .frames = frames->data,
                       .frame_stride = frames->stride[0],
                       .row_stride = frames->stride[2],
                       .point = point->data,
                       .point_stride = point->stride[0]};
    return ok;
}

/* Read the observation matrix of k rows from rows (n), components (n) and coefficients (n, m). */
static int get_observation_matrix(ObservationMatrix *h, const Array *a, Size k, Size n_ends, Size m)
{
    const Array *rows = a, *components = a + 1, *coefficients = a + 2;
    const Size n = rows->view.shape[0], *row = rows->data, *component = components->data;
    int ok = has_shape(components, n, 0, 0, 0) && has_shape(coefficients, n, m, 0, 0);
    for (Size i = 0; ok && i < n; i++)
        ok = row[i] >= 0 && row[i] < k && component[i] >= 0 && component[i] < 6 * n_ends &&
             (!i || row[i] >= row[i - 1]);
    *h = (ObservationMatrix){.count = n,
                             .rows = row,
                             .components = component,
                             .coefficients = coefficients->data,
                             .stride = coefficients->stride[0]};
    return ok;
}

static PyObject *py_point_jacobian(PyObject *self, PyObject *args)
{
    (void)self;
    static const ArraySpec specs[] = {
        {"frames", 4, 'd'}, {"point", 2, 'd'}, {"bodies", 1, 's'}, {"twists", 2, 'd'}, {"out", 3, 'D'}};
    Array a[5];
    if (!get_arrays(a, args, specs, 5))
        return NULL;
    const Array *out = a + 4;
    const Size m = a[1].view.shape[1];
    ErrorTwists errors;
    const int ok = get_error_twists(&errors, a) && has_shape(out, errors.count, 6, m, 0);
    if (ok) {
        Py_BEGIN_ALLOW_THREADS;
        point_jacobian(&errors, m, out->data, out->stride[0], out->stride[1]);
        Py_END_ALLOW_THREADS;
    }
    return finish(a, 5, ok);
}

static PyObject *py_apply_observation_matrix(PyObject *self, PyObject *args)
{
    (void)self;
    static const ArraySpec specs[] = {{"jacobian", 3, 'd'},
                                      {"rows", 1, 's'},
                                      {"components", 1, 's'},
                                      {"coefficients", 2, 'd'},
                                      {"out", 3, 'D'}};
    Array a[5];
    if (!get_arrays(a, args, specs, 5))
        return NULL;
    const Array *jacobian = a, *out = a + 4;
    const Size p = out->view.shape[0], k = out->view.shape[1], m = out->view.shape[2];
    const Size n_ends = m ? jacobian->view.shape[2] / m : 1;
    ObservationMatrix h;
    const int ok =
        has_shape(jacobian, p, 6, n_ends * m, 0) && get_observation_matrix(&h, a + 1, k, n_ends, m);
    if (ok) {
        Py_BEGIN_ALLOW_THREADS;
        apply_observation_matrix(&h, p, k, m, jacobian->data, jacobian->stride[0], jacobian->stride[1],
                                 out->data, out->stride[0], out->stride[1]);
        Py_END_ALLOW_THREADS;
    }
    return finish(a, 5, ok);
}

static PyObject *py_perturb_frames(PyObject *self, PyObject *args)
{
    (void)self;
    static const ArraySpec specs[] = {{"body_from_urdf", 3, 'd'}, {"origins", 4, 'd'},    {"tool", 3, 'd'},
                                      {"error_frames", 1, 's'},   {"twists", 3, 'd'},     {"x", 2, 'd'},
                                      {"displacements", 4, 'D'},  {"body_twists", 3, 'D'}};
    Array a[8];
    if (!get_arrays(a, args, specs, 8))
        return NULL;
    /* Origins, tool and twists are those of each of b members, or one of each for all. */
    const Size n = a->view.shape[0], p = a[3].view.shape[0], b = a[5].view.shape[0],
               given = a[1].view.shape[0], *error_frames = a[3].data;
    int ok = has_shape(a, n, 4, 4, 0) && has_shape(a + 1, given, n, 4, 4) && has_shape(a + 2, given, 4, 4, 0) &&
             has_shape(a + 4, given, p, 6, 0) && (given == b || given == 1) && has_shape(a + 5, b, p, 0, 0) &&
             has_shape(a + 6, b, 2 * n + 2, 4, 4) && has_shape(a + 7, b, p, 6, 0);
    for (int i = 0; i < 8; i++)
        ok = ok && is_contiguous(a + i);
    for (Size i = 0; ok && i < p; i++)
        ok = error_frames[i] >= (i ? error_frames[i - 1] : 0) && error_frames[i] < 2 * n + 2;
    for (Size i = 0; ok && i < b; i++) {
        const Size own = given == b ? i : 0;
        perturb_frames(n, p, a->data, (double *)a[1].data + own * 16 * n, (double *)a[2].data + own * 16,
                       error_frames, (double *)a[4].data + own * 6 * p, (double *)a[5].data + i * p,
                       (double *)a[6].data + i * 16 * (2 * n + 2), (double *)a[7].data + i * 6 * p);
    }
    return finish(a, 8, ok);
}

static PyObject *py_log_rotations(PyObject *self, PyObject *args)
{
    (void)self;
    static const ArraySpec specs[] = {{"rotations", 3, 'd'}, {"out", 2, 'D'}};
    Array a[2];
    if (!get_arrays(a, args, specs, 2))
        return NULL;
    const Size m = a->view.shape[2];
    if (!has_shape(a, 3, 3, m, 0) || !has_shape(a + 1, 3, m, 0, 0))
        return finish(a, 2, 0);
    const Size n_near_half_turn =
        log_rotations(m, a->data, a->stride[0], a->stride[1], a[1].data, a[1].stride[0]);
    release(a, 2);
    return PyLong_FromSsize_t(n_near_half_turn);
}

static PyObject *py_right_jacobian_inverse_batch(PyObject *self, PyObject *args)
{
    (void)self;
    static const ArraySpec specs[] = {{"rotvecs", 2, 'd'}, {"out", 3, 'D'}};
    Array a[2];
    if (!get_arrays(a, args, specs, 2))
        return NULL;
    const Size m = a->view.shape[1];
    const int ok = has_shape(a, 3, m, 0, 0) && has_shape(a + 1, 3, 3, m, 0);
    if (ok)
        right_jacobian_inverses(m, a->data, a->stride[0], a[1].data, a[1].stride[0], a[1].stride[1]);
    return finish(a, 2, ok);
}

/* Return the number of doubles of work memory; see `work_size` in qr.h. */
static PyObject *py_work_size(PyObject *self, PyObject *args)
{
    (void)self;
    Size c, k, n_ends;
    return PyArg_ParseTuple(args, "nnn", &c, &k, &n_ends) ? PyLong_FromSsize_t(work_size(c, k, n_ends))
                                                          : NULL;
}

static PyObject *py_r_factors(PyObject *self, PyObject *args)
{
    (void)self;
    static const ArraySpec specs[] = {{"rows", 4, 'd'}, {"work", 1, 'D'}, {"out", 3, 'D'}};
    Array a[3];
    if (!get_arrays(a, args, specs, 3))
        return NULL;
    const Array *rows = a, *out = a + 2;
    const Size b = rows->view.shape[0], c = rows->view.shape[1];
    const Size k = rows->view.shape[2], m = rows->view.shape[3];
    int ok = has_shape(out, b, c, c, 0) && is_contiguous(out) && a[1].view.shape[0] >= work_size(c, k, 0);
    if (ok) {
        static const ErrorTwists no_errors = {0};
        static const ObservationMatrix no_observation = {0};
        Py_BEGIN_ALLOW_THREADS;
        for (Size i = 0; ok && i < b; i++)
            ok = factor_rows(&no_errors, &no_observation, (double *)rows->data + i * rows->stride[0], c, k, m,
                             rows->stride[1], rows->stride[2], (double *)out->data + i * c * c, a[1].data);
        Py_END_ALLOW_THREADS;
        if (!ok)
            PyErr_NoMemory();
    }
    return finish(a, 3, ok);
}

static PyObject *py_factor_jacobian(PyObject *self, PyObject *args)
{
    (void)self;
    static const ArraySpec specs[] = {{"frames", 4, 'd'},       {"point", 2, 'd'}, {"bodies", 1, 's'},
                                      {"twists", 3, 'd'},       {"rows", 1, 's'},  {"components", 1, 's'},
                                      {"coefficients", 2, 'd'}, {"given", 3, 'd'}, {"work", 1, 'D'},
                                      {"out", 3, 'D'}};
    Array a[10];
    if (!get_arrays(a, args, specs, 10))
        return NULL;
    const Array *given = a + 7, *work = a + 8, *out = a + 9;
    const Size b = a[3].view.shape[0], k = given->view.shape[1], n = given->view.shape[2],
               n_samples = a[1].view.shape[1];
    ErrorTwists all_errors;
    ObservationMatrix all_terms;
    int ok = get_error_twists(&all_errors, a);
    const Size c = all_errors.count + given->view.shape[0], m = b ? n / b : 0;
    all_errors.n_ends = n ? n_samples / n : 1, all_errors.end_offset = n;
    ok = ok && m * b == n && all_errors.n_ends * n == n_samples &&
         get_observation_matrix(&all_terms, a + 4, k, all_errors.n_ends, n) && has_shape(out, b, c, c, 0) &&
         is_contiguous(out) && work->view.shape[0] >= work_size(c, k, all_errors.n_ends);
    if (ok) {
        Py_BEGIN_ALLOW_THREADS;
        for (Size i = 0; ok && i < b; i++) {
            /* Samples of member i start at i·m. */
            ErrorTwists errors = all_errors;
            ObservationMatrix terms = all_terms;
            errors.frames += i * m, errors.point += i * m, errors.twists += i * 6 * all_errors.count;
            terms.coefficients += i * m;
            ok = factor_rows(&errors, &terms, (double *)given->data + i * m, c, k, m, given->stride[0],
                             given->stride[1], (double *)out->data + i * c * c, work->data);
        }
        Py_END_ALLOW_THREADS;
        if (!ok)
            PyErr_NoMemory();
    }
    return finish(a, 10, ok);
}

static PyObject *py_append_diagonal(PyObject *self, PyObject *args)
{
    (void)self;
    static const ArraySpec specs[] = {
        {"r_factors", 3, 'd'}, {"diagonal", 2, 'd'}, {"target", 2, 'd'}, {"work", 1, 'D'}, {"out", 3, 'D'}};
    Array a[5];
    if (!get_arrays(a, args, specs, 5))
        return NULL;
    const Size b = a[1].view.shape[0], p = a[1].view.shape[1], size = (p + 1) * (p + 1);
    const int ok = has_shape(a, b, p + 1, p + 1, 0) && is_contiguous(a) && is_contiguous(a + 1) &&
                   has_shape(a + 2, b, p, 0, 0) && is_contiguous(a + 2) &&
                   a[3].view.shape[0] >= work_size(p + 1, 1, 0) && has_shape(a + 4, b, p + 1, p + 1, 0) &&
                   is_contiguous(a + 4);
    for (Size i = 0; ok && i < b; i++)
        append_diagonal((double *)a->data + i * size, p, (double *)a[1].data + i * p,
                        (double *)a[2].data + i * p, (double *)a[4].data + i * size, a[3].data);
    return finish(a, 5, ok);
}

static PyObject *py_invert_triangular(PyObject *self, PyObject *args)
{
    (void)self;
    static const ArraySpec specs[] = {{"r", 2, 'd'}, {"out", 2, 'D'}};
    Array a[2];
    if (!get_arrays(a, args, specs, 2))
        return NULL;
    const Size p = a->view.shape[0];
    if (!has_shape(a, p, p, 0, 0) || !has_shape(a + 1, p, p, 0, 0) || !is_contiguous(a + 1))
        return finish(a, 2, 0);
    const double condition = invert_triangular(a->data, a->stride[0], p, a[1].data);
    release(a, 2);
    return PyFloat_FromDouble(condition);
}

static PyObject *py_solve_triangular(PyObject *self, PyObject *args)
{
    (void)self;
    static const ArraySpec specs[] = {{"r_factors", 3, 'd'}, {"sides", 3, 'd'}, {"out", 3, 'D'}};
    Array a[3];
    if (!get_arrays(a, args, specs, 3))
        return NULL;
    const Size b = a->view.shape[0], p = a->view.shape[1], s = a[1].view.shape[2];
    const int ok = has_shape(a, b, p, p, 0) && has_shape(a + 1, b, p, s, 0) && is_contiguous(a + 1) &&
                   has_shape(a + 2, b, p, s, 0) && is_contiguous(a + 2);
    for (Size i = 0; ok && i < b; i++)
        solve_triangular((double *)a->data + i * a->stride[0], a->stride[1], p, s,
                         (double *)a[1].data + i * p * s, (double *)a[2].data + i * p * s);
    return finish(a, 3, ok);
}

static PyMethodDef methods[] = {
    {"cos_sin", py_cos_sin, METH_VARARGS, NULL},
    {"propagate_frames", py_propagate_frames, METH_VARARGS, NULL},
    {"point_jacobian", py_point_jacobian, METH_VARARGS, NULL},
    {"apply_observation_matrix", py_apply_observation_matrix, METH_VARARGS, NULL},
    {"perturb_frames", py_perturb_frames, METH_VARARGS, NULL},
    {"log_rotations", py_log_rotations, METH_VARARGS, NULL},
    {"right_jacobian_inverse_batch", py_right_jacobian_inverse_batch, METH_VARARGS, NULL},
    {"work_size", py_work_size, METH_VARARGS, NULL},
    {"r_factors", py_r_factors, METH_VARARGS, NULL},
    {"factor_jacobian", py_factor_jacobian, METH_VARARGS, NULL},
    {"append_diagonal", py_append_diagonal, METH_VARARGS, NULL},
    {"invert_triangular", py_invert_triangular, METH_VARARGS, NULL},
    {"solve_triangular", py_solve_triangular, METH_VARARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static PyModuleDef_Slot slots[] = {{0, NULL}};

static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, .m_name = "_native", .m_size = 0,
                                    .m_methods = methods, .m_slots = slots};

PyMODINIT_FUNC PyInit__native(void)
{
    return PyModuleDef_Init(&module);
}
