/* The firmware's ELF file: what goes into flash, and where functions and variables are. */
#include <elf.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "chip.h"

enum { AVR_DATA_SPACE = 0x800000 }; /* where the linker places RAM, apart from flash */

static struct {
    uint8_t *file;
    long size;
    const Elf32_Sym *symbols;
    uint32_t symbol_count;
    const char *names;
    uint32_t names_size;
} image;

static int
within(uint64_t offset, uint64_t size)
{
    return offset + size <= (uint64_t)image.size;
}

static int
read_file(const char *path)
{
    FILE *f = fopen(path, "rb");
    if (!f)
        return -1;
    free(image.file);
    memset(&image, 0, sizeof image);
    int bad = fseek(f, 0, SEEK_END) || (image.size = ftell(f)) < (long)sizeof(Elf32_Ehdr) || fseek(f, 0, SEEK_SET)
              || !(image.file = malloc((size_t)image.size))
              || fread(image.file, 1, (size_t)image.size, f) != (size_t)image.size;
    fclose(f);
    return bad ? -1 : 0;
}

static void
find_symbols(const Elf32_Ehdr *header)
{
    const Elf32_Shdr *sections = (const void *)(image.file + header->e_shoff);
    for (int i = 0; i < header->e_shnum; i++) {
        const Elf32_Shdr *s = &sections[i];
        if (s->sh_type != SHT_SYMTAB || !within(s->sh_offset, s->sh_size) || s->sh_link >= header->e_shnum)
            continue;
        const Elf32_Shdr *names = &sections[s->sh_link];
        if (!within(names->sh_offset, names->sh_size))
            continue;
        image.symbols = (const void *)(image.file + s->sh_offset);
        image.symbol_count = s->sh_size / sizeof(Elf32_Sym);
        image.names = (const char *)image.file + names->sh_offset;
        image.names_size = names->sh_size;
    }
}

const char *
image_load(const char *path, uint8_t *flash, uint32_t flash_size)
{
    static char error[300];
    snprintf(error, sizeof error, "%s is not an image for the ATmega2560; `make firmware-atmega2560` builds it", path);
    if (read_file(path))
        return error;
    const Elf32_Ehdr *header = (const void *)image.file;
    if (memcmp(header->e_ident, ELFMAG, SELFMAG) || header->e_ident[EI_CLASS] != ELFCLASS32 || header->e_machine != EM_AVR
        || !within(header->e_phoff, (uint64_t)header->e_phnum * sizeof(Elf32_Phdr))
        || !within(header->e_shoff, (uint64_t)header->e_shnum * sizeof(Elf32_Shdr)))
        return error;
    memset(flash, 0xff, flash_size);
    const Elf32_Phdr *parts = (const void *)(image.file + header->e_phoff);
    for (int i = 0; i < header->e_phnum; i++) {
        const Elf32_Phdr *p = &parts[i];
        if (p->p_type != PT_LOAD || !p->p_filesz || p->p_paddr >= AVR_DATA_SPACE)
            continue;
        if (!within(p->p_offset, p->p_filesz) || (uint64_t)p->p_paddr + p->p_filesz > flash_size)
            return error;
        memcpy(flash + p->p_paddr, image.file + p->p_offset, p->p_filesz);
    }
    find_symbols(header);
    return NULL;
}

int
image_symbol(const char *name, uint32_t *value, uint32_t *size)
{
    for (uint32_t i = 0; i < image.symbol_count; i++) {
        const Elf32_Sym *s = &image.symbols[i];
        if (s->st_name >= image.names_size || strcmp(image.names + s->st_name, name))
            continue;
        *value = s->st_value;
        *size = s->st_size;
        return 0;
    }
    return -1;
}
