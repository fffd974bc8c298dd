/* SPDX-License-Identifier: Apache-2.0 */
/* Says of what, how and by what the kernels beside it were compiled: quadtree_lss/build.py reads it. */

#include <Python.h>

#ifdef __clang__
#define COMPILER __VERSION__
#else
#define COMPILER "gcc " __VERSION__
#endif

static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "built", NULL, 0, NULL};

PyMODINIT_FUNC PyInit_built(void)
{
    PyObject *built = PyModule_Create(&module);
    if (built == NULL
        || PyModule_AddStringConstant(built, "SOURCES", SOURCES) < 0
        || PyModule_AddStringConstant(built, "CYTHON", CYTHON) < 0
        || PyModule_AddStringConstant(built, "COMPILER", COMPILER) < 0
        || PyModule_AddIntConstant(built, "CHECKED", CHECKED) < 0) {
        Py_XDECREF(built);
        return NULL;
    }
    return built;
}
