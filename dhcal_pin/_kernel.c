/* The inner loops of `kinematics` and `reduction`, compiled: the same sums over many samples at once.

   Arrays are of doubles and components first, as in those modules: samples are contiguous. */

#define Py_LIMITED_API 0x030b0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stdlib.h>

#include "_samples.h"
#include "_reduction.h"

/* What a function takes: an array's name, number of axes, and type: d double, s size, ? truth, D doubles that
   are written. */
typedef struct {
    const char *name;
    int axes;
    char type;
} Wanted;

/* An array with its last axis contiguous, its strides in items. */
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

static int take(Array *a, PyObject *from, Wanted wanted)
{
    const int written = wanted.type == 'D';
    if (PyObject_GetBuffer(from, &a->view, PyBUF_STRIDES | PyBUF_FORMAT | (written ? PyBUF_WRITABLE : 0)) < 0)
        return 0;
    const Py_buffer *v = &a->view;
    const char *format = v->format ? v->format : "";
    const char *right = wanted.type == '?' ? "?" : wanted.type == 's' ? "lqn" : "d";
    const Size size = wanted.type == '?' ? 1 : 8;
    int fine = v->ndim == wanted.axes && v->itemsize == size && *format && strchr(right, *format);
    for (int i = 0; fine && i < v->ndim; i++) {
        a->stride[i] = v->strides[i] / size;
        fine = v->strides[i] % size == 0 && (i < v->ndim - 1 || a->stride[i] == 1 || v->shape[i] < 2);
    }
    a->data = v->buf;
    if (!fine) {
        PyErr_Format(PyExc_ValueError, "%s: wants %d axes of %s, the last one contiguous", wanted.name,
                     wanted.axes, right);
        PyBuffer_Release(&a->view);
    }
    return fine;
}

/* Takes all arguments, or none and sets the error. */
static int take_all(Array *a, PyObject *args, const Wanted *wanted, Size count)
{
    if (PyTuple_Size(args) != count) {
        PyErr_Format(PyExc_TypeError, "takes %zd arrays", count);
        return 0;
    }
    for (Size i = 0; i < count; i++)
        if (!take(a + i, PyTuple_GetItem(args, i), wanted[i])) {
            release(a, i);
            return 0;
        }
    return 1;
}

static int is_shaped(const Array *a, Size first, Size second, Size third, Size fourth)
{
    const Size shape[] = {first, second, third, fourth};
    for (int i = 0; i < a->view.ndim; i++)
        if (a->view.shape[i] != shape[i])
            return 0;
    return 1;
}

/* Whether all axes are contiguous. */
static int is_packed(const Array *a)
{
    Size step = 1;
    for (int i = a->view.ndim; i--; step *= a->view.shape[i])
        if (a->stride[i] != step && a->view.shape[i] > 1)
            return 0;
    return 1;
}

static PyObject *answer(Array *a, Size count, int fine)
{
    release(a, count);
    if (fine)
        Py_RETURN_NONE;
    if (!PyErr_Occurred())
        PyErr_SetString(PyExc_ValueError, "the arrays' shapes do not go together");
    return NULL;
}

static PyObject *carry_frames(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"links", 3, 'd'}, {"prismatic", 1, '?'}, {"values", 2, 'd'},
                                    {"cos", 2, 'd'},   {"sin", 2, 'd'},       {"frames", 4, 'D'}};
    Array a[6];
    if (!take_all(a, args, wanted, 6))
        return NULL;
    const Array *links = a, *values = a + 2, *frames = a + 5;
    const Size k = values->view.shape[0], m = values->view.shape[1];
    int fine = is_shaped(links, k + 1, 4, 4, 0) && is_shaped(a + 1, k, 0, 0, 0) &&
               is_shaped(a + 3, k, m, 0, 0) && is_shaped(a + 4, k, m, 0, 0) &&
               is_shaped(frames, k + 2, frames->view.shape[1], 3, m) && frames->view.shape[1] >= 4 &&
               frames->stride[1] == 3 * frames->stride[2];
    for (int i = 0; i < 5; i++)
        fine = fine && is_packed(a + i);
    if (fine) {
        Py_BEGIN_ALLOW_THREADS;
        carry(k + 1, m, links->data, a[1].data, values->data, a[3].data, a[4].data, frames->data,
              frames->stride[0], frames->stride[2]);
        Py_END_ALLOW_THREADS;
    }
    return answer(a, 6, fine);
}

static PyObject *point_velocities(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {
        {"frames", 4, 'd'}, {"point", 2, 'd'}, {"at", 1, 's'}, {"twists", 2, 'd'}, {"out", 3, 'D'}};
    Array a[5];
    if (!take_all(a, args, wanted, 5))
        return NULL;
    const Array *frames = a, *point = a + 1, *at = a + 2, *out = a + 4;
    const Size p = at->view.shape[0], m = point->view.shape[1];
    int fine = is_shaped(frames, frames->view.shape[0], frames->view.shape[1], 3, m) &&
               frames->view.shape[1] >= 4 && frames->stride[1] == 3 * frames->stride[2] &&
               is_shaped(point, 3, m, 0, 0) && is_shaped(a + 3, p, 6, 0, 0) && is_packed(a + 3) &&
               is_shaped(out, p, 6, m, 0);
    const Size *bodies = at->data;
    for (Size i = 0; fine && i < p; i++)
        fine = bodies[i] >= 0 && bodies[i] < frames->view.shape[0];
    if (fine) {
        Py_BEGIN_ALLOW_THREADS;
        velocities(p, m, frames->data, frames->stride[0], frames->stride[2], point->data, point->stride[0],
                   bodies, a[3].data, out->data, out->stride[0], out->stride[1]);
        Py_END_ALLOW_THREADS;
    }
    return answer(a, 5, fine);
}

static PyObject *mix_samples(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"vectors", 3, 'd'}, {"matrices", 3, 'd'}, {"out", 3, 'D'}};
    Array a[3];
    if (!take_all(a, args, wanted, 3))
        return NULL;
    const Array *vectors = a, *matrices = a + 1, *out = a + 2;
    const Size p = vectors->view.shape[0], c = vectors->view.shape[1], m = vectors->view.shape[2];
    const Size k = matrices->view.shape[0];
    const int fine = is_shaped(matrices, k, c, m, 0) && is_shaped(out, p, k, m, 0);
    if (fine) {
        Py_BEGIN_ALLOW_THREADS;
        mix(p, k, c, m, vectors->data, vectors->stride[0], vectors->stride[1], matrices->data,
            matrices->stride[0], matrices->stride[1], out->data, out->stride[0], out->stride[1]);
        Py_END_ALLOW_THREADS;
    }
    return answer(a, 3, fine);
}

static PyObject *carry_twists(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"frames", 3, 'd'}, {"twists", 2, 'd'}, {"out", 2, 'D'}};
    Array a[3];
    if (!take_all(a, args, wanted, 3))
        return NULL;
    const Size p = a->view.shape[0];
    int fine = is_shaped(a, p, 4, 4, 0) && is_shaped(a + 1, p, 6, 0, 0) && is_shaped(a + 2, p, 6, 0, 0);
    for (int i = 0; i < 3; i++)
        fine = fine && is_packed(a + i);
    if (fine)
        carry_all(p, a->data, a[1].data, a[2].data);
    return answer(a, 3, fine);
}

static PyObject *log_rotations(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"turns", 3, 'd'}, {"out", 2, 'D'}};
    Array a[2];
    if (!take_all(a, args, wanted, 2))
        return NULL;
    const Size m = a->view.shape[2];
    if (!is_shaped(a, 3, 3, m, 0) || !is_shaped(a + 1, 3, m, 0, 0))
        return answer(a, 2, 0);
    const Size obtuse = rotation_vectors(m, a->data, a->stride[0], a->stride[1], a[1].data, a[1].stride[0]);
    release(a, 2);
    return PyLong_FromSsize_t(obtuse);
}

static PyObject *right_jacobian_inverses(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"vectors", 2, 'd'}, {"out", 3, 'D'}};
    Array a[2];
    if (!take_all(a, args, wanted, 2))
        return NULL;
    const Size m = a->view.shape[1];
    const int fine = is_shaped(a, 3, m, 0, 0) && is_shaped(a + 1, 3, 3, m, 0);
    if (fine)
        jacobian_inverses(m, a->data, a->stride[0], a[1].data, a[1].stride[0], a[1].stride[1]);
    return answer(a, 2, fine);
}

static PyObject *triangles(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"rows", 4, 'd'}, {"out", 3, 'D'}};
    Array a[2];
    if (!take_all(a, args, wanted, 2))
        return NULL;
    const Py_buffer *rows = &a->view;
    const Size b = rows->shape[0], c = rows->shape[1], k = rows->shape[2], m = rows->shape[3];
    int fine = is_shaped(a + 1, b, c, c, 0) && is_packed(a + 1);
    if (fine) {
        Lanes *block = aligned_alloc(64, (c + 1) * ROWS * sizeof(double));
        double *part = malloc((c * c + 1) * sizeof(double));
        Size *work = malloc((k * (c + 1) + 1) * sizeof(Size));
        fine = block && part && work;
        if (fine) {
            Py_BEGIN_ALLOW_THREADS;
            for (Size i = 0; i < b; i++)
                reduce((double *)a->data + i * a->stride[0], c, k, m, a->stride[1], a->stride[2],
                       (double *)a[1].data + i * c * c, block, work, part);
            Py_END_ALLOW_THREADS;
        } else
            PyErr_NoMemory();
        free(block), free(part), free(work);
    }
    return answer(a, 2, fine);
}

static PyMethodDef methods[] = {
    {"carry_frames", carry_frames, METH_VARARGS, NULL},
    {"point_velocities", point_velocities, METH_VARARGS, NULL},
    {"mix_samples", mix_samples, METH_VARARGS, NULL},
    {"carry_twists", carry_twists, METH_VARARGS, NULL},
    {"log_rotations", log_rotations, METH_VARARGS, NULL},
    {"right_jacobian_inverses", right_jacobian_inverses, METH_VARARGS, NULL},
    {"triangles", triangles, METH_VARARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static PyModuleDef_Slot slots[] = {{0, NULL}};

static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, .m_name = "_kernel", .m_size = 0,
                                    .m_methods = methods, .m_slots = slots};

PyMODINIT_FUNC PyInit__kernel(void)
{
    return PyModuleDef_Init(&module);
}
