/* Reading a 32-bit little-endian ELF image: what is to be loaded where, and the names of its functions. */
#include <elf.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core.h"

enum { SEGMENTS_MAX = 16, MACHINE_ARM = 40 };

struct elf_segment elf_segments[SEGMENTS_MAX];
int elf_segment_count;

static struct {
    uint8_t *bytes;
    size_t size;
    const Elf32_Sym *symbols;
    size_t symbol_count;
    const char *strings;
    size_t strings_size;
} image;

static char error_text[256];

static const char *fail(const char *path, const char *what)
{
    snprintf(error_text, sizeof error_text, "%s: %s", path, what);
    return error_text;
}

static int read_whole(const char *path)
{
    FILE *file = fopen(path, "rb");
    if (!file)
        return -1;
    free(image.bytes);
    memset(&image, 0, sizeof image);
    if (!fseek(file, 0, SEEK_END)) {
        long size = ftell(file);
        rewind(file);
        image.bytes = size > 0 ? malloc((size_t)size) : NULL;
        if (image.bytes)
            image.size = fread(image.bytes, 1, (size_t)size, file);
    }
    fclose(file);
    return image.bytes ? 0 : -1;
}

static int inside(size_t offset, size_t size)
{
    return offset <= image.size && size <= image.size - offset;
}

static void find_symbols(const Elf32_Ehdr *header)
{
    if (header->e_shentsize != sizeof(Elf32_Shdr) || !inside(header->e_shoff, header->e_shnum * sizeof(Elf32_Shdr)))
        return;
    const Elf32_Shdr *sections = (const void *)(image.bytes + header->e_shoff);
    for (int i = 0; i < header->e_shnum; i++) {
        const Elf32_Shdr *s = &sections[i];
        if (s->sh_type != SHT_SYMTAB || s->sh_link >= header->e_shnum || !inside(s->sh_offset, s->sh_size))
            continue;
        const Elf32_Shdr *names = &sections[s->sh_link];
        if (!inside(names->sh_offset, names->sh_size) || !names->sh_size)
            continue;
        image.symbols = (const void *)(image.bytes + s->sh_offset);
        image.symbol_count = s->sh_size / sizeof(Elf32_Sym);
        image.strings = (const char *)image.bytes + names->sh_offset;
        image.strings_size = names->sh_size;
    }
}

const char *elf_load(const char *path)
{
    if (read_whole(path))
        return fail(path, "cannot be read; has the firmware been built?");
    const Elf32_Ehdr *header = (const void *)image.bytes;
    if (image.size < sizeof *header || memcmp(header->e_ident, ELFMAG, SELFMAG)
        || header->e_ident[EI_CLASS] != ELFCLASS32 || header->e_machine != MACHINE_ARM)
        return fail(path, "is no 32-bit ARM ELF image");
    if (header->e_phentsize != sizeof(Elf32_Phdr) || !inside(header->e_phoff, header->e_phnum * sizeof(Elf32_Phdr)))
        return fail(path, "is cut short");
    const Elf32_Phdr *programs = (const void *)(image.bytes + header->e_phoff);
    elf_segment_count = 0;
    for (int i = 0; i < header->e_phnum; i++) {
        if (programs[i].p_type != PT_LOAD || !programs[i].p_filesz)
            continue;
        if (elf_segment_count == SEGMENTS_MAX || !inside(programs[i].p_offset, programs[i].p_filesz))
            return fail(path, "has too many segments or is cut short");
        elf_segments[elf_segment_count++] = (struct elf_segment){
            programs[i].p_paddr, programs[i].p_filesz, image.bytes + programs[i].p_offset
        };
    }
    find_symbols(header);
    return NULL;
}

static const char *name_of(const Elf32_Sym *symbol)
{
    return symbol->st_name < image.strings_size ? image.strings + symbol->st_name : "";
}

uint32_t symbol_address(const char *name)
{
    for (size_t i = 0; i < image.symbol_count; i++)
        if (!strcmp(name_of(&image.symbols[i]), name))
            return image.symbols[i].st_value;
    return 0;
}

const char *symbol_at(uint32_t address)
{
    for (size_t i = 0; i < image.symbol_count; i++) {
        const Elf32_Sym *s = &image.symbols[i];
        uint32_t start = s->st_value & ~1u;
        if (ELF32_ST_TYPE(s->st_info) == STT_FUNC && address >= start && address < start + s->st_size)
            return name_of(s);
    }
    return "?";
}
